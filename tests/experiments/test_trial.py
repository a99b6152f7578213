"""The closed loop: what a trial promises for every seed, and what it does when touch goes wrong."""

import copy
import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import numpy as np
import pytest

from hqp_grasp.control.controller import Step
from hqp_grasp.control.episode import MissPolicy
from hqp_grasp.control.forms import PaperForm, clip_to_limits
from hqp_grasp.control.limits import ConfigurationLimit, StepLimit
from hqp_grasp.errors import InputError, ReachError
from hqp_grasp.experiments.record import COLUMNS
from hqp_grasp.experiments.start import Start
from hqp_grasp.experiments.trial import Trial, _in_transit
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, stack_of
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.touch.physical import PhysicalProbe
from hqp_grasp.touch.simulated import SimulatedHand, Truth
from hqp_grasp.world.scene import Prism, Scene

CLIP_TOLERANCE = 1e-09
TOUCH_RANK = 1e-06

SEEDS = (0, 1, 2)
PROBES = 10
GAP = 1e-8  # [rad] asked for
TIMINGS = {"solve_us"}
MISSED = Missed(Miss.NO_TOUCH, "finger_2")

SHARES = MissPolicy().shares


class Hand:
    """A probe that feels what another feels, `touches` times; then it misses. It keeps targets."""

    def __init__(self, inner, touches=10**9, first=None):
        self.inner, self.touches, self.first, self.targets = inner, touches, first, []

    def touch(self, q_target):
        self.targets.append(np.array(q_target))
        if len(self.targets) > self.touches:
            return MISSED
        if self.first is not None and len(self.targets) == 1:
            return self.first
        return self.inner.touch(q_target)


class Replay:
    """A probe that returns these, one after the other, whatever it is asked."""

    def __init__(self, *outcomes):
        self.outcomes, self.targets = list(outcomes), []

    def touch(self, q_target):
        self.targets.append(np.array(q_target))
        return self.outcomes.pop(0)


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def stack():
    return stack_of("fmk")


@pytest.fixture(scope="module")
def trial(scene, stack):
    return Trial(scene, stack, probes=PROBES)


@pytest.fixture(scope="module")
def records(trial):
    return {seed: trial.run(seed) for seed in SEEDS}


def but_timings(row):
    return {name: value for name, value in row.items() if name not in TIMINGS}


# ---------------------------------------------------------------- every seed


def test_one_seed_gives_bitwise_one_record(records, stack):
    again = Trial(Scene(), stack, probes=PROBES).run((SEEDS[1],))
    before = records[SEEDS[1]]
    assert [*map(but_timings, again.rows)] == [*map(but_timings, before.rows)]
    assert (again.seed, again.rejected) == (before.seed, before.rejected)
    for one, other in zip(again.grasps, before.grasps, strict=True):
        np.testing.assert_array_equal(one.q, other.q)


def test_a_trial_does_not_depend_on_those_before_it_with_the_same_probe(trial, scene, records):
    probe = GeometricProbe(scene)
    trial.run(SEEDS[2], probe)
    again = trial.run(SEEDS[0], probe)
    assert [*map(but_timings, again.rows)] == [*map(but_timings, records[SEEDS[0]].rows)]


def test_different_seeds_give_different_starts(records):
    starts = {record.rows[0]["adduction_deg"] for record in records.values()}
    assert len(starts) == len(SEEDS)


def test_rows_are_the_first_touch_and_one_for_each_probe(records):
    for record in records.values():
        assert len(record.rows) == PROBES + 1
        assert len(record.grasps) == sum(row["in_contact"] for row in record.rows)
        assert all(set(row) >= set(COLUMNS) for row in record.rows)
        assert not record.lost


def test_no_step_led_to_the_first_touch(records):
    for record in records.values():
        first = record.rows[0]
        assert first["in_contact"] and first["outcome"] == "touch"
        assert not first["limit_active"]
        for name in ("step_share", "hqp_projection_gap", "solve_us", "method"):
            assert first[name] is None
        for row in record.rows[1:]:
            assert row["step_share"] in SHARES and row["solve_us"] > 0.0 and row["method"]


def test_errors_fall_and_every_trial_converges(records):
    for record in records.values():
        force, moment = record.column("eps_f"), np.sqrt(record.column("eps_m"))
        assert record.converged_at is not None and record.converged_at <= PROBES
        assert force[-1] <= 1e-5 < force[0]
        assert moment[-1] <= 5e-4 < moment[0]


def test_no_joint_is_ever_outside_its_range(records, scene):
    robot = scene.articulated
    for record in records.values():
        assert set(record.column("limit_violation")) == {0.0}
        assert max(robot.violation(grasp.q) for grasp in record.grasps) == 0.0


def test_hierarchy_and_projection_agree_wherever_no_limit_is_active(records):
    compared = 0
    for record in records.values():
        for row in record.rows[1:]:
            assert (row["hqp_projection_gap"] is None) == row["limit_active"]
            if not row["limit_active"]:
                assert row["hqp_projection_gap"] <= GAP
                compared += 1
    assert compared > 0


def test_with_wide_caps_nearly_every_step_is_compared(scene, stack, records):
    wide = stack.within(StepLimit(2.0, 0.5), ConfigurationLimit(scene.articulated))
    probe = Hand(GeometricProbe(scene), first=records[SEEDS[0]].grasps[-1])
    rows = Trial(scene, wide, probes=5).run(SEEDS[0], probe).rows
    assert all(row["hqp_projection_gap"] <= GAP for row in rows[1:])


def test_errors_in_the_rows_are_those_of_the_grasps(records):
    record = records[SEEDS[0]]
    felt = [row for row in record.rows if row["in_contact"]]
    for row, grasp in zip(felt, record.grasps, strict=True):
        f = -grasp.normals.sum(axis=0)
        lever = grasp.positions - grasp.positions.mean(axis=0)
        m = np.cross(lever, -grasp.normals).sum(axis=0)
        velocity = np.array(
            [grasp.contact_jacobian(i)[:, c.flexion[0]] for i, c in enumerate(grasp.contacts)]
        )
        along = np.abs((velocity * grasp.normals).sum(axis=1))
        angle = np.arccos(np.minimum(1.0, along / np.linalg.norm(velocity, axis=1)))
        assert row["eps_f"] == pytest.approx(f @ f, rel=1e-9, abs=1e-15)
        assert row["eps_m"] == pytest.approx(m @ m, rel=1e-9, abs=1e-15)
        assert row["eps_k"] == pytest.approx(angle.mean(), rel=1e-6)
        assert row["eps_k_eq7"] == pytest.approx(along.sum(), rel=1e-9)


def test_a_column_is_asked_for_by_a_valid_name(records):
    with pytest.raises(InputError, match=r"unknown column 'eps'.*eps_f, eps_m"):
        records[SEEDS[0]].column("eps")


# ---------------------------------------------------------------- forms


@pytest.mark.parametrize("form", ["clipped", "paper"])
def test_every_form_begins_with_the_same_touch_and_descends(scene, stack, records, form):
    record = Trial(scene, stack, probes=PROBES, form=form).run(SEEDS[0])
    assert record.rows[0] == records[SEEDS[0]].rows[0]
    np.testing.assert_array_equal(record.grasps[0].q, records[SEEDS[0]].grasps[0].q)
    assert all(row["hqp_projection_gap"] is None for row in record.rows)
    assert set(record.column("limit_violation")) == {0.0}
    force = record.column("eps_f")
    assert force[-1] < 0.1 * force[0]


def test_without_landing_short_steps_descend_too(scene, stack, records):
    short = stack.within(StepLimit(0.05, 0.005), ConfigurationLimit(scene.articulated))
    record = Trial(scene, short, probes=PROBES, landing=False).run(SEEDS[0])
    assert record.rows[0] == records[SEEDS[0]].rows[0]
    assert not record.lost
    assert record.rows[-1]["eps_f"] < 0.5 * record.rows[0]["eps_f"]
    assert set(record.column("limit_violation")) == {0.0}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"form": "hirarchy"}, r"unknown form 'hirarchy'.*hierarchy, clipped, paper"),
        ({"links": "stop"}, r"unknown links 'stop'.*pass, block"),
        ({"probes": 0}, "probes must be at least 1; got 0"),
    ],
)
def test_a_wrong_setting_is_named_with_the_valid_ones(scene, stack, setting, message):
    with pytest.raises(InputError, match=message):
        Trial(scene, stack, **setting)


def test_an_object_out_of_reach_is_named(stack):
    with pytest.raises(ReachError, match="move the object"):
        Trial(Scene(position=(3.0, 0.0, 0.2)), stack, probes=2, start=Start(max_draws=2)).run(0)


def test_a_failure_on_the_way_is_raised_by_run_and_recorded_by_attempt(trial, scene, records):
    class Broken(Hand):
        def touch(self, q_target):
            if len(self.targets) == self.touches:
                raise ZeroDivisionError("sensor gone")
            return super().touch(q_target)

    full = Hand(GeometricProbe(scene))
    trial.run(SEEDS[1], full)
    touches = len(full.targets) - PROBES + 2  # the start's and two more
    with pytest.raises(ZeroDivisionError, match="sensor gone"):
        trial.run(SEEDS[1], Broken(GeometricProbe(scene), touches))
    record = trial.attempt(SEEDS[1], Broken(GeometricProbe(scene), touches))
    assert record.error == "ZeroDivisionError: sensor gone"
    assert len(record.rows) == PROBES + 1
    whole = [*map(but_timings, trial.run(SEEDS[1], full).rows)]
    assert [*map(but_timings, record.rows[:3])] == whole[:3]
    assert not any(row["in_contact"] for row in record.rows[3:])
    assert trial.attempt(SEEDS[1]).error is None


def test_a_trial_can_begin_from_a_grasp(trial, records):
    first = records[SEEDS[0]].grasps[0]
    again = dataclasses.replace(trial, start=first).run(SEEDS[0])
    assert again.rejected == 0
    ours, theirs = (
        [{k: v for k, v in row.items() if k != "rejected"} for row in map(but_timings, r.rows)]
        for r in (again, records[SEEDS[0]])
    )
    assert ours == theirs


def test_a_hand_without_an_arm_is_placed_by_the_draw(stack):
    scene = Scene(robot="bhand")
    record = Trial(scene, stack, probes=4).run((0, 0))
    assert record.rows[0]["in_contact"] and record.rows[0]["other_links"] == ""
    low, high = np.degrees(Start().elevation)
    assert low <= record.rows[0]["elevation_deg"] <= high
    with pytest.raises(InputError, match=r"placed by the draw.*Trial\(start=grasp\)"):
        Trial(scene, stack, probes=1).run(0, GeometricProbe(scene))


def test_threads_that_share_a_probe_record_what_one_alone_does(trial, scene, records):
    probe = GeometricProbe(scene)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda seed: trial.run(seed, probe), SEEDS * 2))
    for seed, record in zip(SEEDS * 2, found, strict=True):
        assert [*map(but_timings, record.rows)] == [*map(but_timings, records[seed].rows)]


@pytest.mark.parametrize("corners", [3, 4, 5])
def test_whole_trials_on_prisms_end_without_an_error(corners, stack):
    prism = Prism.regular(corners, 0.08 if corners < 5 else 0.06)
    trial = Trial(Scene(object=prism), stack, probes=8)
    for seed in (0, 7):
        assert trial.attempt((0, seed)).error is None


# ---------------------------------------------------------------- misses


def test_misses_shorten_the_step_then_the_trial_is_lost(scene, stack, records):
    first, second = records[SEEDS[0]].grasps[:2]
    hand = Replay(first, second, MISSED, MISSED, MISSED)
    record = Trial(scene, stack, probes=6, form="memoryless", landing=False).run(SEEDS[0], hand)
    steps = [target - second.q for target in hand.targets[-3:]]
    assert len(steps) == len(SHARES) == 3 and np.abs(steps[0]).max() > 1e-3
    for share, step in zip(SHARES, steps, strict=True):
        np.testing.assert_allclose(step, share * steps[0], atol=1e-14)
    assert record.lost and record.converged_at is None
    assert len(record.rows) == 7 and len(record.grasps) == 2
    assert [row["in_contact"] for row in record.rows] == [True, True] + 5 * [False]


def test_the_row_of_a_loss_tells_the_reason_and_later_rows_are_empty(scene, stack, records):
    first = records[SEEDS[0]].grasps[0]
    hand = Replay(first, MISSED, Missed(Miss.OWN_LINK, "finger_1"), MISSED)
    rows = Trial(scene, stack, probes=6, form="memoryless").run(SEEDS[0], hand).rows
    errors = ("eps_f", "eps_m", "eps_k", "eps_k_eq7", "adduction_deg", "elevation_deg")
    for row, share in zip(rows[1:4], SHARES, strict=True):
        assert row["step_share"] == share and row["method"]
        assert row["limit_violation"] == 0.0
        assert all(row[name] is None for name in errors)
    told = [row["outcome"] for row in rows[1:5]]
    lost, inside = f"{Miss.NO_TOUCH.value} (finger_2)", f"{Miss.OWN_LINK.value} (finger_1)"
    assert told == [
        lost,
        inside,
        lost,
        f"gave up: 3 misses from one grasp, the last: {lost}",
    ]
    reactions = [row["reaction"] for row in rows[1:5]]
    assert reactions == [None, "0.5 of the step", "0.25 of the step", "gave up"]
    for row in rows[5:]:
        assert row["in_contact"] is False and row["limit_active"] is False
        told = {name for name, value in row.items() if value not in (None, False, 0.0, "")}
        assert told == set()


@pytest.mark.parametrize("misses", [1, 2])
def test_a_shorter_step_that_touches_carries_the_trial_on(scene, stack, records, misses):
    first, second = records[SEEDS[0]].grasps[:2]
    hand = Replay(first, *[MISSED] * misses, second, first)
    record = Trial(scene, stack, probes=misses + 2, form="memoryless").run(SEEDS[0], hand)
    assert not record.lost
    shares = [row["step_share"] for row in record.rows]
    assert shares == [None, *SHARES[: misses + 1], 1.0]
    assert [row["in_contact"] for row in record.rows] == [True, *[False] * misses, True, True]
    np.testing.assert_array_equal(record.grasps[1].q, second.q)


def test_a_trial_that_is_lost_keeps_what_it_felt_before(trial, scene):
    full = Hand(GeometricProbe(scene))
    whole = trial.run(SEEDS[1], full)
    started = len(full.targets) - PROBES  # touches that the start took
    hand = Hand(GeometricProbe(scene), touches=started + 4)
    record = trial.run(SEEDS[1], hand)
    assert len(hand.targets) == started + PROBES  # it goes on trying
    kept = [*map(but_timings, record.rows[:5])]
    assert kept == [*map(but_timings, whole.rows[:5])]
    assert not any(row["in_contact"] for row in record.rows[5:])


# ---------------------------------------------------------------- a hand of another kind


class SensedHand:
    """What a driver of a real hand would tell: wrenches, noisy normals, no Hessian."""

    def __init__(self, scene):
        self.robot, self.inner = scene.articulated, GeometricProbe(scene)
        self.rng = np.random.default_rng(0)

    def touch(self, q_target):
        felt = self.inner.touch(q_target)
        if isinstance(felt, Missed):
            return felt
        contacts = []
        for contact in felt.contacts:
            normal = contact.normal + 1e-3 * self.rng.standard_normal(3)
            normal /= np.linalg.norm(normal)
            contacts.append(
                Contact(
                    contact.position,
                    normal,
                    flexion=contact.flexion,
                    wrench=[*-normal, 0.0, 0.0, 0.0],
                )
            )
        return Grasp(
            felt.q, contacts, felt.jacobian, coupling=self.robot.coupling, offset=self.robot.offset
        )


def test_a_probe_of_another_kind_is_all_that_a_real_hand_needs(scene):
    trial = Trial(scene, stack_of("fm"), probes=15)
    record = trial.run(SEEDS[0], SensedHand(scene))
    assert not record.lost
    assert record.column("eps_f")[-1] < 1e-3 < record.column("eps_f")[0]


# ---------------------------------------------------------------- limits


def narrowed(robot, joint, lower, upper):
    """The robot with another range for one joint, at home within it."""
    model = copy.copy(robot.model)
    model.jnt_range[model.joint(joint).id] = lower, upper
    home = robot.description.home
    home = {**home, joint: min(max(home[joint], lower), upper)}
    about = dataclasses.replace(robot.description, home=home)
    return dataclasses.replace(robot, description=about, model=model)


def narrowed_scene(folder, scene, joint, old, new):
    """The scene with a robot folder of its own: one joint has another range, and is home in it."""
    about = scene.articulated.description
    source = about.xml
    text = source.read_text()
    line = next(row for row in text.splitlines() if f'<joint name="{joint}"' in row)
    assert line.count(f'range="{old}"') == 1
    changed = line.replace(f'range="{old}"', f'range="{new[0]!r} {new[1]!r}"')
    (folder / source.name).write_text(text.replace(line, changed))
    home = {**about.home, joint: min(max(about.home[joint], new[0]), new[1])}
    table = ", ".join(f"{name} = {angle!r}" for name, angle in home.items())
    text = (source.parent / "robot.toml").read_text()
    assert text.count('home = "home"') == 1
    (folder / "robot.toml").write_text(text.replace('home = "home"', f"home = {{ {table} }}"))
    return Scene(folder, scene.object, scene.position)


@pytest.fixture(scope="module")
def tight(records, scene):
    """Grasps, each with a robot whose arm may hardly move from there."""
    robot = scene.articulated
    cases = []
    for record in records.values():
        for grasp in record.grasps[:2]:
            limited = robot
            for joint in [robot.joints[j] for j in robot.arm[:5]]:
                q = grasp.q[robot.index(joint)]
                limited = narrowed(limited, joint, q - 2e-3, q + 2e-3)
            limits = StepLimit(), ConfigurationLimit(limited)
            cases.append((grasp, limited, limits))
    return cases


def force_left(x, grasp):
    task = ForceTask()
    return np.linalg.norm(task.jacobian(grasp) @ x + task.error(grasp))


def test_at_a_limit_the_hierarchy_keeps_forces_priority_and_the_clipped_step_does_not(tight):
    worse = 0
    for grasp, limited, limits in tight:
        stack = dataclasses.replace(stack_of("fmk"), hold_contacts=False)
        stack = stack.within(*limits)
        solution = HQP(rank_tolerance=TOUCH_RANK).solve(stack.levels(grasp))
        assert solution.limit_active and solution.is_optimal(stack.levels(grasp))
        projected = Projection(rank_tolerance=TOUCH_RANK).solve(stack.law_levels(grasp))
        clipped = clip_to_limits(projected.x, stack, grasp)
        for x in (solution.x, clipped):
            assert limited.violation(grasp.q + x) <= CLIP_TOLERANCE
        ours, theirs = force_left(solution.x, grasp), force_left(clipped, grasp)
        assert ours <= theirs + 1e-9
        worse += theirs > 1.1 * ours + 1e-6
    assert worse >= len(tight) // 2


def test_at_a_limit_lower_laws_change_nothing_for_force(tight):
    for grasp, _, limits in tight:
        alone, above = (
            HQP(rank_tolerance=TOUCH_RANK).solve(stack_of(letters).within(*limits).levels(grasp)).x
            for letters in ("f", "fmk")
        )
        assert force_left(above, grasp) == pytest.approx(force_left(alone, grasp), abs=1e-9)


def test_with_limits_active_throughout_only_the_strict_hierarchy_converges(tmp_path, scene, trial):
    """The arm's first joint begins at its lower limit, and the laws go on pulling it further."""
    stack = ForceTask() >> MomentTask() >> KinematicTask(form="rows")
    first = trial.run(3).grasps[0]
    j = scene.articulated.index("wam_j1")
    lower = float(first.q[j])
    limited = narrowed_scene(tmp_path, scene, "wam_j1", "-2.6 2.6", (lower, 2.6))
    found = {}
    for form in ("memoryless", "clipped"):
        hand = Hand(GeometricProbe(limited, links="pass"), first=first)
        found[form] = Trial(limited, stack, probes=PROBES, form=form).run(3, hand)
        assert set(found[form].column("limit_violation")) == {0.0}
    assert all(row["limit_active"] for row in found["memoryless"].rows[1:])
    at = [grasp.q[j] for grasp in found["memoryless"].grasps]
    assert min(at) >= lower and sum(q == pytest.approx(lower, abs=CLIP_TOLERANCE) for q in at) >= 5
    assert found["memoryless"].converged_at is not None
    assert found["clipped"].converged_at is None


def test_a_start_outside_a_range_walks_back_within_the_caps(tmp_path, scene, stack, records):
    first = records[SEEDS[0]].grasps[0]
    j = scene.articulated.index("wam_j5")
    upper = float(first.q[j]) - 0.5
    limited = narrowed_scene(tmp_path, scene, "wam_j5", "-4.76 1.24", (-4.76, upper))
    hand = Hand(GeometricProbe(limited), first=first)
    record = Trial(limited, stack, probes=5).run(SEEDS[0], hand)
    cap = StepLimit().joint
    away = [0.5, 0.5 - cap, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(record.column("limit_violation"), away, atol=CLIP_TOLERANCE)
    assert set(record.column("limit_violation")[2:]) == {0.0}
    assert not record.lost


def test_a_joint_inside_its_range_stays_there_while_another_walks_back(scene, stack, records):
    robot = scene.articulated
    first = records[SEEDS[0]].grasps[0]
    outside, inside = robot.index("wam_j5"), robot.index("wam_j6")
    q = first.q.copy()
    q[outside] = robot.q_upper[outside] + 0.5
    q[inside] = robot.q_upper[inside]
    start = dataclasses.replace(first, q=q)
    hand = Replay(start, first)
    Trial(scene, stack, probes=1, landing=False).run(SEEDS[0], hand)
    target = hand.targets[-1]
    assert target[inside] <= robot.q_upper[inside]
    assert robot.q_upper[outside] < target[outside] < q[outside]


def test_a_stack_with_caps_of_its_own_still_keeps_the_robots_ranges(scene, stack):
    record = Trial(scene, stack.within(StepLimit()), probes=PROBES).run(SEEDS[2])
    assert set(record.column("limit_violation")) == {0.0}
    assert record.converged_at is not None


def test_what_the_papers_form_leaves_of_the_moment_is_in_proportion_to_its_damping():
    left = []
    for damping in (1e-5, 1e-6):
        form = PaperForm(Projection(damping=damping))
        record = Trial(Scene(), stack_of("fmk"), probes=25, form=form).run(SEEDS[0])
        left.append(np.sqrt(record.rows[-1]["eps_m"]))
    assert left[0] == pytest.approx(10.0 * left[1], rel=0.05)


# ---------------------------------------------------------------- how often a hand is built


@pytest.mark.parametrize(("preset", "hands"), [(None, 1), ("loadcell", 1)])
def test_a_physical_trial_builds_its_hand_once_and_touches_first_once(
    scene, stack, monkeypatch, preset, hands
):
    built, touched = [], []
    build, touch = SimulatedHand.__init__, PhysicalProbe.touch

    def building(self, *arguments, **settings):
        built.append(self)
        build(self, *arguments, **settings)

    def touching(self, *arguments, **settings):
        touched.append(self)
        return touch(self, *arguments, **settings)

    monkeypatch.setattr(SimulatedHand, "__init__", building)
    monkeypatch.setattr(PhysicalProbe, "touch", touching)
    record = Trial(scene, stack, probes=1, probe="physical", preset=preset).run(0)
    assert record.rejected == 0
    assert len(built) == hands and len(touched) == 2


def test_a_violation_is_the_worst_of_where_a_joint_was_sent_and_where_it_is():
    scene = Scene()
    trial, robot = Trial(scene, ForceTask(), probes=1), scene.articulated
    contacts = [Contact(x, n) for x, n in zip(0.05 * np.eye(3), np.eye(3), strict=True)]

    def outside(by):
        q = robot.home.copy()
        q[0] = robot.q_upper[0] + by
        return q

    for sent, reached, worst in ((0.02, 0.05, 0.05), (0.05, 0.02, 0.05), (-0.1, -0.1, 0.0)):
        felt = robot.grasp(outside(reached), contacts)
        for told, due in ((felt, worst), (Missed(Miss.STUCK, "x"), max(sent, 0.0))):
            row = trial._row(robot, trial.stack, Touch(outside(sent), told), None, None, None)
            assert row["limit_violation"] == pytest.approx(due)

    class Hand:
        worst: ClassVar = {"range [rad]": 0.3, "force [N]": 1.0, "speed share": 0.2} | {
            "torque share": 0.4
        }

        def truth(self):
            return Truth(None, None, None, None, None, 0.004, 0.0, ("f1_distal",), ())

    row = trial._row(robot, trial.stack, Touch(outside(0.02), told), None, Hand(), None)
    assert row["limit_violation"] == 0.3 and row["object_moved"] == 0.004
    assert (row["peak_force"], row["peak_speed"], row["peak_torque"]) == (1.0, 0.2, 0.4)
    assert row["other_links"] == "f1_distal" and row["eps_f_true"] is None


def test_links_in_transit_are_looked_for_from_where_the_hand_is_over_the_way_it_passes():
    class Looks(GeometricProbe):
        ways: ClassVar = []

        def in_transit(self, way):
            self.ways.append([q.copy() for q in way])
            return ("palm", "f1_distal")

    scene = Scene()
    probe = Looks(scene)
    n = scene.articulated.n
    first = Start().draw(scene, lambda _: GeometricProbe(scene), np.random.default_rng(0)).grasp
    target, passed = np.full(n, 0.1), np.full(n, 0.2)
    for before, begins in (
        (Touch(np.zeros(n), first), first.q),
        (Touch(np.full(n, 0.3), Missed(Miss.NO_TOUCH, "x")), np.full(n, 0.3)),
    ):
        step = Step(target, (passed,))
        told = _in_transit(probe, [before, Touch(target, first)], step)
        assert told == {"in_transit": "palm, f1_distal"}
        np.testing.assert_array_equal(Looks.ways[-1], [begins, passed, target])
    assert (
        _in_transit(None, [before, before], step)
        == {}
        == _in_transit(probe, [before, before], Step(None))
    )
