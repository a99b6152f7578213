"""Questions answered from results: shares with intervals, pairs, and the trials that failed."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.stats import binomtest

from hqp_grasp.errors import ResultsError
from hqp_grasp.experiments.report import interval, outcomes, paired_difference, report

BALANCED, OFF = (1e-4, 1e-6), (1e-2, 1e-6)  # ε_f [N²], ε_m [(N·m)²]
LOST = (None, None)
# Trials of four rows each, by the errors of their rows.
TRIALS = {
    "good from the start": [BALANCED] * 4,
    "good from 2": [OFF, OFF, BALANCED, BALANCED],
    "relapsed": [OFF, BALANCED, OFF, BALANCED],
    "lost": [OFF, BALANCED, LOST, LOST],
    "not balanced": [BALANCED, BALANCED, BALANCED, OFF],
}


def write(folder, trials, **columns):
    """A results folder with these trials; `columns` overrule whole columns of one trial."""
    rows = []
    for number, errors in enumerate(trials):
        for probe, (force, moment) in enumerate(errors):
            touched = force is not None
            rows.append(
                {
                    "trial": number,
                    "seed": 5,
                    "probe": probe,
                    "eps_f": force,
                    "eps_m": moment,
                    "in_contact": touched,
                    "other_links": "",
                    "limit_violation": 0.0,
                    "friction_demand": 0.1 if touched else None,
                    "error": None,
                    "adduction_deg": 50.0 + number if touched else None,
                    "outcome": "touch" if touched else "missed",
                    "method": "proxqp",
                }
            )
    for name, (number, values) in columns.items():
        for row, value in zip((r for r in rows if r["trial"] == number), values, strict=True):
            row[name] = value
    folder.mkdir()
    schema = pa.Table.from_pylist(rows).schema
    at = schema.get_field_index("error")
    schema = schema.set(at, pa.field("error", pa.string()))
    # Rows in any order: a reader sorts.
    rows = [rows[i] for i in np.random.default_rng(0).permutation(len(rows))]
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), folder / "probes.parquet")
    return folder


def test_each_trial_has_a_verdict_and_the_probe_from_which_it_stays_balanced(tmp_path):
    found = outcomes(write(tmp_path / "a", TRIALS.values()))
    assert [o.verdict for o in found] == ["good", "good", "good", "lost", "not balanced"]
    assert [o.balanced_at for o in found] == [0, 2, 3, None, None]
    assert [o.trial for o in found] == [0, 1, 2, 3, 4] and {o.seed for o in found} == {5}
    assert found[3].adduction == 53.0  # of its last touch


def test_links_violations_and_errors_are_kinds_of_their_own(tmp_path):
    trials = [[BALANCED] * 4] * 3
    folder = write(
        tmp_path / "a",
        trials,
        other_links=(0, ["", "palm", "", ""]),
        limit_violation=(1, [0.0, 0.0, 1e-3, 0.0]),
        error=(2, [None, None, None, "SolverError: why"]),
    )
    assert [o.verdict for o in outcomes(folder)] == ["link inside", "violation", "error"]


def test_true_errors_decide_where_they_are_known(tmp_path):
    folder = write(tmp_path / "a", [[BALANCED] * 2])
    table = pq.read_table(folder / "probes.parquet")
    for name, value in (("eps_f_true", 1.0), ("eps_m_true", 0.0)):
        table = table.append_column(name, pa.array([value] * len(table)))
    pq.write_table(table, folder / "probes.parquet")
    assert outcomes(folder)[0].verdict == "not balanced"


def test_secure_trials_stand_beside_good_ones_with_those_that_were_so_once(tmp_path):
    demands = ([0.5, 0.1, 0.3, 0.1], [0.1, 0.1, 0.1, 0.3], [0.9] * 4, [0.1] * 4)
    folder = write(tmp_path / "a", [[OFF] * 4] * 4)
    table = pq.read_table(folder / "probes.parquet")
    at = table.column_names.index("friction_demand")
    keys = zip(table["trial"].to_pylist(), table["probe"].to_pylist(), strict=True)
    values = pa.array([demands[trial][probe] for trial, probe in keys])
    pq.write_table(table.set_column(at, "friction_demand", values), folder / "probes.parquet")
    found = outcomes(folder)
    assert [o.secure for o in found] == [True, False, False, True]
    assert [o.secure_at for o in found] == [1, 0, None, 0]
    assert [o.secure_since for o in found] == [3, None, None, 0]
    said = report([folder])
    assert "2 [15.0%, 85.0%]" in said  # of four
    assert "secure once 3 [30.1%, 95.4%], first at probe 0 (0.98, 1)" in said
    assert "to the end from 1.5 (2.97, 3); once and not at the end 1 [4.6%, 69.9%]" in said
    # A folder from before friction demands tells the rest.
    pq.write_table(table.drop_columns(["friction_demand"]), folder / "probes.parquet")
    assert outcomes(folder)[0].secure is None and "secure once" not in report([folder])


@pytest.mark.parametrize(("count", "total"), [(0, 10), (10, 10), (878, 1000), (1, 3)])
def test_intervals_of_a_share_are_wilsons(count, total):
    known = binomtest(count, total).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(interval(count, total), (known.low, known.high), atol=2e-5)


def test_the_interval_of_a_paired_difference_covers_it_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(400):
        one = rng.random(200) < 0.9
        other = np.where(rng.random(200) < 0.8, one, rng.random(200) < 0.7)
        truth = (0.8 * 0.9 + 0.2 * 0.7) - 0.9
        difference, low, high = paired_difference(one.tolist(), other.tolist())
        assert difference == pytest.approx(other.mean() - one.mean())
        covered += low <= truth <= high
    assert 0.92 <= covered / 400 <= 0.98


def test_a_paired_difference_has_its_covariance_in_its_interval():
    """Agresti and Min: (b − c)/n' ± 1.96 √(b + c − (b − c)²/n')/n', with half a pair more each."""
    for better, worse, both, neither in ((20, 5, 60, 15), (0, 30, 40, 30), (3, 3, 4, 0)):
        one = [True] * worse + [False] * better + [True] * both + [False] * neither
        other = [False] * worse + [True] * better + [True] * both + [False] * neither
        n = better + worse + both + neither
        difference, low, high = paired_difference(one, other)
        assert difference == pytest.approx((better - worse) / n)
        # The variance of a mean of n + 2 differences, each 1, 0 or −1.
        pairs = np.repeat(
            [1.0, -1.0, 0.0], [2 * better + 1, 2 * worse + 1, 2 * (both + neither + 1)]
        )
        width = 1.96 * pairs.std() / np.sqrt(n + 2)
        assert (high + low) / 2 == pytest.approx(pairs.mean())
        assert (high - low) / 2 == pytest.approx(width)
    assert paired_difference([True] * 2, [False] * 2)[1] == -1.0  # no share is more than all
    assert paired_difference([False] * 2, [True] * 2)[2] == 1.0


def test_a_report_counts_pairs_and_names_who_failed(tmp_path):
    one = write(tmp_path / "one", TRIALS.values())
    other = write(tmp_path / "other", [[BALANCED] * 4] * 5)
    said = report([one, other])
    assert f"{one}" in said and "3 [" in said and "5 [" in said
    assert f"{other} against {one}, 5 pairs: good +40.0%" in said
    assert f"lost: trial 3 of seed 5: hqp-grasp view {one} --trial 3" in said
    assert "2 (2.98, 3)" in said  # probes to balance


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda path: path.mkdir(), "it is no results folder"),
        (lambda path: (path.mkdir(), (path / "probes.parquet").write_bytes(b"PAR1")), "is broken"),
    ],
)
def test_a_folder_without_results_is_named(tmp_path, prepare, message):
    prepare(tmp_path / "a")
    with pytest.raises(ResultsError, match=message):
        outcomes(tmp_path / "a")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.drop_columns(["eps_f"]), "no column 'eps_f'"),
        (lambda rows: rows.drop_columns(["adduction_deg"]), "no column 'adduction_deg'"),
        (lambda rows: rows.drop_columns(rows.column_names[1:]), "no column 'seed'"),
        (lambda rows: rows[:0], "no rows"),
        (
            lambda rows: rows.set_column(0, "trial", rows["trial"].cast(pa.string())),
            "'trial' holds string, not whole numbers",
        ),
    ],
)
def test_a_folder_without_what_a_report_needs_says_what_is_missing(tmp_path, change, message):
    folder = write(tmp_path / "a", TRIALS.values())
    file = folder / "probes.parquet"
    pq.write_table(change(pq.read_table(file)), file)
    with pytest.raises(ResultsError, match=rf"a/probes\.parquet is broken \(.*{message}\); run"):
        report([folder])
