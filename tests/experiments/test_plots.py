"""What the figures show: which numbers, in which unit, where they begin and end."""

import codecs

import numpy as np
import pyarrow as pa
import pytest

from hqp_grasp.experiments.plain import _plain, speak_plainly
from hqp_grasp.experiments.plots import convergence_figure, picked_figure
from hqp_grasp.experiments.table import table_of

NAN = float("nan")
# Three trials of four probes each.
ROWS = {
    "eps_f": [[4.0, 1.0, 1e-2, 0.0], [9.0, 2.0, 1e-3, NAN], [1.0, 3.0, 1e-4, NAN]],
    "eps_m": [[4e-4, 1e-4, 9e-6, 1e-6], [16e-4, NAN, 4e-6, NAN], [1e-4, 25e-4, 1e-6, NAN]],
    "eps_k": [[0.5, 0.4, 0.1, 0.2], [0.6, 0.3, 0.2, NAN], [0.7, 0.2, 0.3, NAN]],
    "adduction_deg": [[10, 20, 30, 40], [11, 21, 31, NAN], [12, 22, NAN, NAN]],
    "elevation_deg": [[50, 51, 52, 53], [60, 61, 62, NAN], [70, 71, NAN, NAN]],
}


@pytest.fixture(scope="module")
def figure():
    columns = {name: np.array(rows, dtype=float).ravel() for name, rows in ROWS.items()}
    return convergence_figure(pa.table({"trial": np.repeat([0, 1, 2], 4)} | columns), "all of it")


def points(line):
    return np.column_stack(line.get_data()).tolist()


def band(axes, i):
    """{probe: (least, most)} of the i-th area."""
    corners = axes.collections[i].get_paths()[0].vertices
    spans = {x: corners[corners[:, 0] == x, 1] for x in np.unique(corners[:, 0])}
    return {int(x): (float(y.min()), float(y.max())) for x, y in spans.items()}


def test_errors_are_drawn_by_their_median_within_the_range_of_all_trials(figure):
    left, middle, _ = figure.axes
    force, moment, *limits = left.get_lines()
    assert points(force) == [[0, 4.0], [1, 2.0], [2, 1e-3], [3, 1e-16]]  # no zero on a log axis
    np.testing.assert_allclose(points(moment), [[0, 20.0], [1, 30.0], [2, 2.0], [3, 1.0]])
    assert left.get_yscale() == "log" and middle.get_yscale() == "linear"
    assert [line.get_ydata()[0] for line in limits] == [1e-3, 2.0]  # N², mm·N
    assert [line.get_color() for line in limits] == [force.get_color(), moment.get_color()]
    assert band(left, 0) == {0: (1.0, 9.0), 1: (1.0, 3.0), 2: (1e-4, 1e-2), 3: (1e-16, 1e-16)}
    (angle,) = middle.get_lines()
    np.testing.assert_allclose(points(angle), [[0, 0.6], [1, 0.3], [2, 0.2], [3, 0.2]])
    assert band(middle, 0)[0] == (0.5, 0.7) and middle.get_ylim()[0] == 0.0


def test_probes_that_no_trial_felt_are_left_out():
    lost = np.array(ROWS["eps_k"], dtype=float)
    lost[:, 2] = NAN
    columns = dict.fromkeys(ROWS, lost.ravel())
    table = pa.table({"trial": np.repeat([0, 1, 2], 4)} | columns)
    (angle,) = convergence_figure(table, "").axes[1].get_lines()
    assert [x for x, _ in points(angle)] == [0, 1, 3]


def test_postures_are_drawn_where_each_trial_began_and_where_it_was_felt_last(figure):
    start, end = figure.axes[2].get_lines()
    assert points(start) == [[10, 50], [11, 60], [12, 70]]
    assert points(end) == [[40, 53], [31, 62], [22, 71]]
    assert (start.get_label(), end.get_label()) == ("start", "end")
    assert figure.get_suptitle() == "all of it"


LOOKS = [
    {"time": 5.0 + 0.1 * i, "phase": phase, "strength": 5.0 + i, "load": 0.5 * i, "normal": normal}
    for i, (phase, normal) in enumerate(
        [
            ("tighten", [1.0, 2.0, 3.0]),
            ("tighten", []),
            ("lift", [4.0, 5.0, 6.0]),
            ("lift", [4.5, 5.5, 6.5]),
            ("lower", [1.5, 2.5, 3.5]),
        ]
    )
]


def test_a_picks_forces_are_drawn_from_its_first_look_on_with_gaps_where_nothing_was_felt():
    (axes,) = picked_figure(LOOKS, "").axes
    *normals, asked, load = axes.get_lines()
    assert len(normals) == 3
    for line in (*normals, asked, load):
        np.testing.assert_allclose(line.get_xdata(), [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(normals[1].get_ydata(), [2.0, NAN, 5.0, 5.5, 2.5])
    np.testing.assert_array_equal(asked.get_ydata(), [5.0, 6.0, 7.0, 8.0, 9.0])
    np.testing.assert_array_equal(load.get_ydata(), [0.0, 0.5, 1.0, 1.5, 2.0])
    assert [line.get_label() for line in normals][2] == "normal force, contact 3"


def test_the_phases_of_a_pick_stand_behind_it_from_begin_to_end():
    (axes,) = picked_figure(LOOKS, "").axes
    spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]
    np.testing.assert_allclose(spans, [(0.0, 0.2), (0.2, 0.4), (0.4, 0.4)], atol=1e-12)
    assert [text.get_text() for text in axes.texts] == ["tighten", "lift", "lower"]
    np.testing.assert_allclose([text.get_position()[0] for text in axes.texts], [0.1, 0.3, 0.4])
    assert {text.get_position()[1] for text in axes.texts} == {1.01}  # above the axes
    assert all(text.get_transform() == axes.get_xaxis_transform() for text in axes.texts)


# ---------------------------------------------------------------- tables and texts


def test_a_table_has_the_types_of_its_units_and_gaps_where_a_row_has_none():
    about = {"why": "text: why", "so": "bool: so", "many": "count: many", "f": "N: force"}
    rows = [{"why": "x", "so": True, "many": 3, "f": 1.5, "more": 0}, {"f": 2.0}]
    table = table_of(rows, about)
    types = {name: str(table.schema.field(name).type) for name in table.column_names}
    assert types == {"why": "string", "so": "bool", "many": "int64", "f": "double"}
    assert table.to_pylist()[0] == {"why": "x", "so": True, "many": 3, "f": 1.5}
    assert table.to_pylist()[1] == {"why": None, "so": None, "many": None, "f": 2.0}
    assert table.schema.field("f").metadata == {b"meaning": b"N: force"}


def test_what_a_terminal_lacks_is_said_in_words_or_without_accents():
    speak_plainly()
    for text, plain in (
        ("µ ≤ 0.5 °", "u <= 0.5  deg"),
        ("φ_f ▷ φ_m", "phi_f > phi_m"),
        ("Zoë's ﬁle", "Zoe's file"),
        ("力", "?"),
        ("√ε_m · Δ²", "sqrt eps_m * d^2"),
    ):
        assert text.encode("ascii", "hqp_grasp.plain").decode() == plain
    assert "ε→é".encode("latin-1", "hqp_grasp.plain").decode("latin-1") == "eps->é"
    with pytest.raises(UnicodeDecodeError):
        b"\xff".decode("ascii", "hqp_grasp.plain")
    assert codecs.lookup_error("hqp_grasp.plain") is _plain
