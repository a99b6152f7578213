"""What a trial leaves behind: every law, contact and joint in its row, and why it ended."""

import dataclasses
import sys
from typing import ClassVar

import numpy as np
import pyarrow as pa
import pytest
from own_law import HeightTask

from hqp_grasp.control.controller import Controller
from hqp_grasp.errors import InputError, ReachError, SingularTaskError, SolverError
from hqp_grasp.experiments import start
from hqp_grasp.experiments.record import (
    COLUMNS,
    Record,
    empty_row,
    felt_row,
    holds,
    kind_and_message,
    law_columns,
    secures,
    verdicts,
)
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.mechanics import friction_demand
from hqp_grasp.tasks import ContactTask, ForceTask, KinematicTask, MomentTask, Stack
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Scene

CONVERGED_FORCE = 0.001
CONVERGED_MOMENT = 0.002

PROBES = 4


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def stack():
    return ForceTask() >> MomentTask() + KinematicTask() >> HeightTask()


@pytest.fixture(scope="module")
def trial(scene, stack):
    return Trial(scene, stack, probes=PROBES, form="memoryless")


@pytest.fixture(scope="module")
def record(trial):
    return trial.run(0)


def made(force, moment=None, **settings):
    """A record with these errors; contact is lost where there are none."""
    rows = []
    for f, m in zip(force, moment or [0.0] * len(force), strict=True):
        row = dict.fromkeys(COLUMNS) | {"eps_f": f, "eps_m": m, "in_contact": f is not None}
        row["friction_demand"] = None if f is None else 0.1
        rows.append(row | {"other_links": "", "limit_violation": 0.0})
    return Record((0,), tuple(rows), (), 0, (), **settings)


def felt(record):
    """The rows with a grasp, and these grasps."""
    return zip([row for row in record.rows if row["in_contact"]], record.grasps, strict=True)


# ---------------------------------------------------------------- laws


def test_every_law_has_its_error_by_its_name_in_every_row(record, stack):
    for row, grasp in felt(record):
        for task in stack.tasks:
            assert row[f"error_{task.name}"] == np.linalg.norm(task.error(grasp))
    assert {"error_force", "error_moment", "error_kinematic", "error_height"} <= set(record.rows[0])


def test_status_and_rank_of_a_law_are_those_of_its_level_in_the_step_that_led_there(trial, record):
    controller, probe = trial.controller(trial.scene), GeometricProbe(trial.scene)
    history = [Touch(record.grasps[0].q, record.grasps[0])]
    assert all(record.rows[0][f"{c}_{n}"] is None for c in ("status", "rank") for n in ("force",))
    for row in record.rows[1:]:
        step = controller.step(history)
        force, both, height = step.solution.levels[-3:]
        assert (row["status_force"], row["rank_force"]) == (force.status, force.rank)
        for name in ("moment", "kinematic"):  # they share a level
            assert (row[f"status_{name}"], row[f"rank_{name}"]) == (both.status, both.rank)
        assert (row["status_height"], row["rank_height"]) == (height.status, height.rank)
        history.append(Touch(step.q_target, probe.touch(step.q_target)))
    assert {row["status_force"] for row in record.rows[1:]} <= {"met", "nearest"}


def test_a_law_named_as_the_level_above_has_its_own_level(record):
    """The contacts are held by a level named "contact", above a law of that name."""
    grasp = record.grasps[0]
    stack = Stack.of(ForceTask()) >> ContactTask()
    solution = HQP().solve(stack.levels(grasp))
    assert [level.name for level in solution.levels] == ["contact", "force", "contact"]
    assert solution.levels[0].rank == 3 and solution.levels[2].rank == 0
    assert law_columns(stack, grasp, solution)["rank_contact"] == 0


def test_where_a_form_has_no_level_for_a_law_its_status_is_null(scene):
    record = Trial(scene, ForceTask() >> MomentTask(), probes=1, form="paper").run(0)
    assert record.rows[1]["error_force"] > 0.0
    assert record.rows[1]["status_force"] is None and record.rows[1]["rank_force"] is None


def test_a_probe_that_missed_says_how_the_laws_fared_in_its_step(scene, record):
    class Nothing:
        def touch(self, q_target):
            return Missed(Miss.NO_TOUCH, "finger_1")

    start = record.grasps[0]
    plain = Trial(scene, ForceTask(), probes=1, form="memoryless", start=start)
    missed = plain.run(0, Nothing()).rows[1]
    assert missed["status_force"] in ("met", "nearest") and missed["rank_force"] in (1, 2, 3)
    assert missed["error_force"] is None and missed["contact_1_x"] is None


def test_what_is_missing_in_a_column_is_nan_or_none(record):
    status, rank = record.column("status_force"), record.column("rank_force")
    assert status[0] is None and isinstance(status[1], str)
    assert np.isnan(rank[0]) and rank[1] in (1.0, 2.0, 3.0)


def test_a_law_that_the_stack_lacks_is_null_where_it_is_undefined(scene, record):
    """It ended trials: five flexions that move a contact equally fast two ways, or not at all."""
    grasp = record.grasps[0]
    still = grasp.jacobian.copy()
    still[:, grasp.contacts[1].flexion] = 0.0
    without = [dataclasses.replace(c, flexion=()) for c in grasp.contacts]
    for odd in (
        dataclasses.replace(grasp, jacobian=still),
        dataclasses.replace(grasp, contacts=tuple(without)),
    ):
        begun = Trial(scene, ForceTask() >> MomentTask(), probes=2, start=odd).run(0)
        assert begun.rows[0]["eps_k"] is None and np.isnan(begun.column("eps_k")[0])
        assert begun.rows[0]["eps_f"] > 0.0 and begun.rows[1]["eps_k"] > 0.0
        check = begun.to_table()
        assert check["eps_k"].null_count == 1
    # Eq. 7 is defined where flexions stand still: nothing presses.
    assert Trial(scene, ForceTask(), probes=1, start=grasp).run(0).rows[0]["eps_k_eq7"] > 0.0


class Whimsical(HeightTask):
    """A law that is undefined from the second grasp on, or at the first."""

    raises: ClassVar[Exception] = SingularTaskError("undefined up there")
    at: ClassVar[float] = 0.0

    def error(self, grasp):
        if grasp.q[0] != self.at:
            raise self.raises
        return super().error(grasp)


def test_a_law_of_the_stack_is_null_in_the_row_where_it_is_undefined(scene, record, monkeypatch):
    """The row is kept with all the rest of it; the step from there says what is wrong."""
    start = record.grasps[0]
    monkeypatch.setattr(Whimsical, "at", start.q[0])
    stack = ForceTask() >> MomentTask() >> Whimsical()
    trial = Trial(scene, stack, probes=1, form="memoryless", start=start)
    last = trial.run(0)
    assert last.error is None
    for row, there in zip(last.rows, (True, False), strict=True):
        assert (row["error_whimsical"] is not None) is there
        assert row["error_force"] > 0.0 and row["in_contact"] and row["contact_1_x"]
    told = dataclasses.replace(trial, probes=2).attempt(0)
    assert told.error.startswith("SingularTaskError: undefined up there; raised by the law")
    assert [row["in_contact"] for row in told.rows] == [True, True, False]
    # A law that is broken is no such thing.
    monkeypatch.setattr(Whimsical, "raises", ZeroDivisionError("a bug"))
    told = trial.attempt(0)
    assert told.error.startswith("ZeroDivisionError: a bug")


def test_the_rule_that_planned_a_step_stands_in_its_row(record, scene):
    assert [row["planner"] for row in record.rows] == [None] + ["memoryless"] * PROBES
    assert record.to_table()["planner"].type == pa.string()
    rows = Trial(scene, ForceTask() >> MomentTask(), probes=12).run(0).rows
    assert {row["planner"] for row in rows[1:]} >= {"surface felt", "return to the best grasp"}


# ---------------------------------------------------------------- contacts and joints


def test_a_grasp_can_be_drawn_from_its_row(record, scene):
    for row, grasp in felt(record):
        for i, contact in enumerate(grasp.contacts, 1):
            at = [row[f"contact_{i}_{axis}"] for axis in "xyz"]
            normal = [row[f"contact_{i}_n{axis}"] for axis in "xyz"]
            assert at == contact.position.tolist() and normal == contact.normal.tolist()
        assert [row[f"q_{joint}"] for joint in scene.articulated.joints] == grasp.q.tolist()


def test_a_contact_stands_in_the_columns_of_the_point_that_touches(scene, stack, record):
    grasp = record.grasps[0]
    turned = dataclasses.replace(
        grasp,
        contacts=grasp.contacts[::-1],
        jacobian=np.concatenate(np.split(grasp.jacobian, 3)[::-1]),
        hessian=np.concatenate(np.split(grasp.hessian, 3)[::-1]),
    )
    row = felt_row(scene.articulated, stack, turned)
    assert row["contact_1_x"] == grasp.contacts[0].position[0]
    unnamed = tuple(dataclasses.replace(contact, name="") for contact in turned.contacts)
    row = felt_row(scene.articulated, stack, dataclasses.replace(turned, contacts=unnamed))
    assert row["contact_1_x"] == grasp.contacts[2].position[0]


def test_a_row_without_touch_has_the_same_columns(scene, stack, record):
    nothing = empty_row(scene.articulated, stack)
    assert [list(row) for row in record.rows] == [list(nothing)] * (PROBES + 1)
    assert {name for name, value in nothing.items() if value} == set()


# ---------------------------------------------------------------- the record


def test_the_table_of_a_record_has_its_rows_with_types_and_meanings(record):
    table = record.to_table()
    assert table.column("probe").to_pylist() == list(range(PROBES + 1))
    for name in record.rows[0]:
        assert table.column(name).to_pylist() == [row[name] for row in record.rows]
    kinds = {name: str(table.schema.field(name).type) for name in table.column_names}
    assert kinds["status_height"] == kinds["outcome"] == kinds["error"] == "string"
    assert kinds["rank_height"] == kinds["rejected"] == "int64"
    assert kinds["error_height"] == kinds["contact_3_nz"] == kinds["q_wam_j1"] == "double"
    assert kinds["in_contact"] == kinds["limit_active"] == "bool"
    assert all(field.metadata[b"meaning"] for field in table.schema)
    assert "null" not in set(kinds.values())


def test_without_pandas_the_way_to_it_is_named(monkeypatch, record):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install pandas.*to_table\(\)"):
        record.to_pandas()


def test_a_data_frame_has_a_row_for_every_probe(record):
    pytest.importorskip("pandas")
    frame = record.to_pandas()
    assert len(frame) == PROBES + 1
    np.testing.assert_array_equal(frame["error_height"], record.column("error_height"))


def test_a_record_is_printed_in_one_short_line(record):
    assert len(repr(record)) < 100 and "\n" not in repr(record)
    assert "seed (0,): 5 rows" in repr(record)
    assert "converged at probe 1" in repr(made([1.0, 0.0]))
    assert "not converged" in repr(made([1.0, 1.0]))
    assert "lost" in repr(made([1.0, None], [1.0, None]))
    assert "ended by SolverError: no" in repr(made([1.0], error="SolverError: no"))


@pytest.mark.parametrize(
    ("force", "moment", "first"),
    [
        ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], 1),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0),
        ([1.0, 0.0, 1.0, 0.0, 0.0], [0.0] * 5, 3),  # a relapse starts the count anew
        ([0.0, 0.0], [1.0, 0.0], 1),
        ([0.0, 1.0], [0.0, 0.0], None),
        ([0.0, None], [0.0, None], None),
        ([CONVERGED_FORCE, 1.01 * CONVERGED_FORCE], [0.0, 0.0], None),
        ([0.0, 0.0], [CONVERGED_MOMENT**2, 1.01 * CONVERGED_MOMENT**2], None),
    ],
)
def test_converged_is_from_where_both_errors_stay_small_to_the_end(force, moment, first):
    assert made(force, moment).converged_at == first


# ---------------------------------------------------------------- failures


def failing(monkeypatch, error, touches=2):
    """From now on the controller raises `error` once so many touches are made."""
    step = Controller.step

    def raising(self, history):
        if len(history) == touches:
            raise error
        return step(self, history)

    monkeypatch.setattr(Controller, "step", raising)


def test_a_failure_inside_a_trial_is_raised_by_run_and_told_by_attempt(monkeypatch, trial, record):
    failing(monkeypatch, SolverError("no method found an answer"))
    with pytest.raises(SolverError, match="no method found an answer"):
        trial.run(0)
    told = trial.attempt(0)
    assert told.error == "SolverError: no method found an answer"
    assert len(told.rows) == PROBES + 1 and len(told.grasps) == 2
    kept = [{**row, "solve_us": 0.0} for row in record.rows[:2]]
    assert [{**row, "solve_us": 0.0} for row in told.rows[:2]] == kept
    nothing = empty_row(trial.scene.articulated, trial.stack)
    assert list(told.rows[2:]) == [nothing] * (PROBES - 1)
    assert told.to_table().column("error").to_pylist() == [told.error] * (PROBES + 1)


def test_a_start_that_cannot_be_found_is_told_too(scene, stack):
    far = dataclasses.replace(scene, position=(3.0, 0.0, 0.2))
    trial = Trial(far, stack, probes=PROBES, start=start.Start(max_draws=2))
    with pytest.raises(ReachError):
        trial.run(0)
    told = trial.attempt(0)
    assert told.error.startswith("ReachError: wam_bhand touches the object")
    assert len(told.rows) == PROBES + 1 and told.lost and told.grasps == ()


def test_an_interrupt_is_no_failure_of_the_trial(monkeypatch, trial):
    failing(monkeypatch, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        trial.attempt(0)


def test_what_a_law_of_ones_own_raises_names_the_law(scene, record):
    @dataclasses.dataclass(frozen=True)
    class RatioTask(HeightTask):
        def error(self, grasp):
            raise ZeroDivisionError("no denominator")

    told = Trial(scene, ForceTask() >> RatioTask(), probes=1, start=record.grasps[0]).attempt(0)
    assert told.error.startswith("ZeroDivisionError: no denominator; raised by the law 'ratio'")
    assert "\n" not in told.error


def test_notes_of_an_error_are_part_of_what_is_told():
    error = ValueError("two\nlines")
    error.add_note("and a note")
    assert kind_and_message(error) == "ValueError: two lines; and a note"


@pytest.mark.parametrize("seed", [-1, (0, -1), (-1, 0), (), "x"], ids=str)
def test_a_seed_is_whole_numbers_from_zero_on(trial, seed):
    for begin in (trial.run, trial.attempt):
        with pytest.raises(InputError, match="seed"):
            begin(seed)


# ---------------------------------------------------------------- verdicts


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ([{}, {}, {}], "good"),
        ([{"eps_f": 1.0, "other_links": "palm"}, {}, {}], "good"),  # the start is not judged
        ([{}, {"eps_f": 1.0, "eps_m": 1.0}, {}], "good"),
        ([{}, {"limit_violation": 1e-12}, {}], "violation"),
        ([{"limit_violation": 1e-12}, {"other_links": "palm"}, {}], "link inside"),
        ([{}, {"other_links": "palm"}, {"eps_f": 1.01e-3}], "not balanced"),
        ([{}, {}, {"eps_m": 4.01e-6}], "not balanced"),
        ([{}, {}, {"eps_f": 1e-3, "eps_m": 4e-6}], "good"),
        ([{}, {"eps_f": None, "eps_m": None, "in_contact": False}, {}], "good"),
        ([{}, {}, {"eps_f": None, "eps_m": None, "in_contact": False}], "lost"),
        ([{"error": "E: x"}, {"error": "E: x"}, {"in_contact": False, "error": "E: x"}], "error"),
    ],
)
def test_a_trial_is_good_or_fails_by_the_gravest_of_its_faults(changes, verdict):
    fine = {"trial": 3, "in_contact": True, "eps_f": 0.0, "eps_m": 0.0, "other_links": ""}
    fine |= {"limit_violation": 0.0, "error": None}
    rows = [{**fine, "probe": i, **change} for i, change in enumerate(changes)]
    assert verdicts(pa.Table.from_pylist(rows[::-1])) == {3: verdict}


def test_where_what_is_felt_is_not_what_is_the_true_errors_count():
    rows = [
        {"trial": 0, "probe": 0, "in_contact": True, "eps_f": 0.0, "eps_m": 0.0, "error": None}
        | {"other_links": "", "limit_violation": 0.0, "eps_f_true": 0.1, "eps_m_true": 0.0}
    ]
    assert verdicts(pa.Table.from_pylist(rows)) == {0: "not balanced"}


@pytest.mark.parametrize(
    ("changes", "secure"),
    [
        ([{}, {}, {}], True),
        ([{"friction_demand": 1.0}, {"friction_demand": np.inf}, {}], True),  # the end counts
        ([{}, {}, {"friction_demand": 0.2}], True),
        ([{}, {}, {"friction_demand": 0.201}], False),
        ([{}, {}, {"friction_demand": np.inf}], False),
        ([{}, {}, {"friction_demand": None, "in_contact": False}], False),
        ([{}, {"other_links": "palm"}, {}], False),
        ([{"other_links": "palm"}, {}, {"eps_f": 1.0}], True),  # neither start nor balance counts
        ([{}, {"limit_violation": 1e-12}, {}], False),
        ([{"error": "E: x"}, {"error": "E: x"}, {"error": "E: x"}], False),
    ],
)
def test_a_trial_is_secure_if_little_friction_holds_its_last_grasp(changes, secure):
    fine = {"trial": 3, "in_contact": True, "eps_f": 0.0, "eps_m": 0.0, "other_links": ""}
    fine |= {"limit_violation": 0.0, "error": None, "friction_demand": 0.1}
    rows = [{**fine, "probe": i, **change} for i, change in enumerate(changes)]
    table = pa.Table.from_pylist(rows[::-1])
    assert secures(table) == {3: secure}
    # What is felt does not count where what is is known.
    true = pa.array([row["friction_demand"] for row in rows[::-1]], pa.float64())
    at = table.column_names.index("friction_demand")
    felt = table.set_column(at, "friction_demand", pa.array([1.0] * len(rows)))
    assert secures(felt.append_column("friction_demand_true", true)) == {3: secure}


def test_every_touch_has_its_friction_demand_and_a_record_its_verdicts(record):
    for row, grasp in felt(record):
        assert row["friction_demand"] == friction_demand(grasp.positions, grasp.normals)
    assert record.secure is (record.rows[-1]["friction_demand"] <= 0.2)
    assert made([1.0, 1.0]).secure and made([1.0, 1.0]).verdict == "not balanced"
    assert not made([0.0, None], [0.0, None]).secure


def test_a_friction_demand_reads_as_what_holds():
    assert holds(0.0567) == "holds if µ ≥ 0.06"
    assert holds(np.inf) == "no friction holds it"


def on_cone(lean, turns, axis):
    """Grasps of three on a cone about `axis` (3,), whose walls lean by `lean` [rad]."""
    frame = np.linalg.qr(np.column_stack([axis, np.eye(3)[:, :2]]))[0]
    frame *= np.sign(frame[:, 0] @ axis)
    grasps = []
    for turn in turns:
        t = turn + np.array([0.0, 1.9, 4.1])
        n = np.column_stack(
            [np.full(3, np.sin(lean)), *(np.cos(lean) * f(t) for f in (np.cos, np.sin))]
        )
        contacts = [Contact(0.05 * v, v) for v in n @ frame.T]
        grasps.append(Grasp(np.zeros(2), contacts, np.zeros((9, 2))))
    return grasps


@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.0, 0.6, -0.8]])
def test_walls_that_lean_are_told_by_their_angle(axis):
    def told(*grasps):
        return dataclasses.replace(made([1.0, 1.0]), grasps=grasps).unbalanced

    for degrees in (1.0, 3.0, 15.4):
        grasps = on_cone(np.radians(degrees), range(8), np.array(axis))
        said = f"walls lean by about {degrees:.0f}°: equal forces cannot balance"
        assert told(*grasps) == said
        # A rim that was touched now and then is no wall.
        rim = dataclasses.replace(grasps[0].contacts[0], normal=np.array(axis))
        odd = dataclasses.replace(grasps[0], contacts=(rim, *grasps[0].contacts[1:]))
        assert told(odd, odd, *grasps) == said
    # Nor do three places tell of all the others, however long they are kept.
    tilted = [Contact(c.position, n) for c, n in zip(grasps[0].contacts, np.eye(3), strict=True)]
    kept = dataclasses.replace(grasps[0], contacts=tuple(tilted))
    assert told(*grasps, *[kept] * 30) == said
    # 0.5° leaves less than a balanced grasp may have: balance was there to be found.
    upright = on_cone(np.radians(0.5), range(8), np.array(axis))
    assert told(*upright) == "no grasp was found whose forces balance"


def test_why_a_trial_does_not_balance_is_told_once_and_only_then(record):
    table = record.to_table()
    assert table["unbalanced"].to_pylist() == [record.unbalanced] * (PROBES + 1)
    grasps = on_cone(0.0, range(3), np.array([0.0, 0.0, 1.0]))
    for force, moment, said in (
        ([1.0, 0.0], [1.0, 0.0], None),
        ([0.0, 0.0], [0.0, 1.0], "no grasp was found whose moments balance"),
        ([0.0, None], [0.0, None], "the object is not touched at the end"),
    ):
        assert dataclasses.replace(made(force, moment), grasps=tuple(grasps)).unbalanced == said
