"""Starting postures: the paper's ranges, one seed one start, and an object out of reach."""

import dataclasses
import itertools
import pickle

import numpy as np
import pytest
import tiny_hand
from starts import AWKWARD, begin

from hqp_grasp.errors import InputError, ReachError
from hqp_grasp.experiments.start import Start, _extent, _Place, _reach
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Grasp, Miss, Missed
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.scene import Cylinder, Prism, Scene

SEEDS = range(3)
PLACES, ALIKE = 24, 50  # of the palm in a draw; draws that all fail alike
SHIFT, TURN = 0.01, np.radians(15.0)  # [m], [rad] away from an end
POSE_TOL = 2e-4  # [m], [rad]: twice what the arm's posture is solved to


class Told:
    """A probe that says what it is told to, then what another feels; it remembers its targets."""

    def __init__(self, *outcomes, then=None):
        self.outcomes, self.then, self.targets = list(outcomes), then, []

    def touch(self, q_target):
        self.targets.append(q_target.copy())
        return self.outcomes.pop(0) if self.outcomes else self.then


@pytest.fixture(scope="module", params=[Cylinder(0.05), Prism.regular(6, 0.05)], ids=["cyl", "hex"])
def scene(request):
    return Scene(object=request.param)


@pytest.fixture(scope="module")
def probe(scene):
    return GeometricProbe(scene)


@pytest.fixture(scope="module")
def starts(scene, probe):
    return [first_touch(scene, probe, np.random.default_rng(seed)) for seed in SEEDS]


def first_touch(scene, probe, rng, start=None):
    """What a draw finds with one probe, whatever the scene."""
    return (start or Start()).draw(scene, lambda _: probe, rng)


def palm(scene, q):
    """Position and rotation of the palm."""
    return scene.articulated.palm(q)


def posture(scene, q):
    """Adduction and elevation [deg]."""
    spread = q[scene.articulated.index("bhand_f1_spread")]
    _, R = palm(scene, q)
    return np.degrees([spread, np.arcsin(-R[2, 2])])


def test_a_first_touch_is_a_grasp_with_every_finger_and_every_joint_in_range(scene, starts):
    for found in starts:
        assert isinstance(found.grasp, Grasp)
        assert found.grasp.k == 3
        assert found.rejected >= 0
        assert scene.articulated.violation(found.grasp.q) == 0.0


def test_at_a_first_touch_the_tips_alone_touch_the_upright_side(starts):
    for found in starts:
        assert found.grasp.other_links == ()
        assert np.abs(found.grasp.normals[:, 2]).max() <= 0.05


def test_a_touch_with_another_link_is_no_start(scene, starts):
    good = starts[0].grasp
    crowded = dataclasses.replace(good, other_links=("f2_distal",))
    blocked = Missed(Miss.OTHER_LINK, "f2_distal")
    told = Told(crowded, blocked, then=good)
    found = first_touch(scene, told, np.random.default_rng(5))
    assert found.grasp is good
    assert found.rejected >= 2 and len(told.targets) == 3


@pytest.mark.parametrize("finger", range(3))
@pytest.mark.parametrize("up", [1.0, -1.0])
def test_a_finger_that_meets_an_end_is_brought_nearer_the_middle(scene, starts, finger, up):
    """The palm withdraws, moves down from an upper end (up from a lower one), and turns so too."""
    good = starts[0].grasp
    robot, rng = scene.articulated, np.random.default_rng(5)
    first = Told(then=good)
    first_touch(scene, first, rng)
    before = palm(scene, first.targets[0])
    contacts = list(good.contacts)
    contacts[finger] = dataclasses.replace(contacts[finger], normal=[0.0, 0.0, up])
    on_an_end = robot.grasp(first.targets[0], contacts)
    told = Told(on_an_end, then=good)
    first_touch(scene, told, np.random.default_rng(5))
    assert len(told.targets) == 2
    after = palm(scene, told.targets[1])
    moved, turned = after[0] - before[0], after[1] @ before[1].T
    z = before[1][:, 2]
    np.testing.assert_allclose(after[1][:, 2], z, atol=2 * POSE_TOL)
    expected = -2 * Start().advance * z + [0.0, 0.0, -up * SHIFT]
    np.testing.assert_allclose(moved, expected, atol=2 * POSE_TOL)
    np.testing.assert_allclose(np.trace(turned), 1.0 + 2.0 * np.cos(TURN), atol=1e-3)
    tips = [
        robot.centers(q)[finger] - p
        for q, (p, _) in zip(told.targets, (before, after), strict=True)
    ]
    assert up * (tips[1] - tips[0])[2] < 0.0


def test_a_draw_is_given_up_when_no_place_of_the_palm_helps():
    scene = Scene("bhand")
    good = Start().draw(scene, GeometricProbe, np.random.default_rng(0)).grasp
    top = dataclasses.replace(good.contacts[1], normal=[0.0, 0.0, 1.0])
    above = dataclasses.replace(good, contacts=(good.contacts[0], top, good.contacts[2]))
    told = Told(then=above)
    with pytest.raises(ReachError, match=r"1 drawn .*finger_2 meets an edge or an end"):
        first_touch(scene, told, np.random.default_rng(5), Start(max_draws=1))
    assert len(told.targets) == PLACES


def test_nearly_every_draw_is_followed_to_a_first_touch(scene, probe):
    """Whatever its adduction: 4 in 5 were thrown away when the palm could only advance."""
    rng = np.random.default_rng(8)
    found = [first_touch(scene, probe, rng) for _ in range(25)]
    assert sum(each.rejected for each in found) <= 3
    spreads = [posture(scene, each.grasp.q)[0] for each in found]
    assert sum(spread > 50.0 for spread in spreads) >= 8


def test_adduction_and_elevation_lie_in_the_papers_ranges(scene, starts):
    slack = np.degrees(POSE_TOL)
    for found in starts:
        adduction, elevation = posture(scene, found.grasp.q)
        assert 10.0 - slack <= adduction <= 90.0 + slack
        assert 30.0 - slack <= elevation <= 50.0 + slack


def test_the_palm_faces_the_object_from_the_robots_side(scene, starts):
    """Its axis meets the object's, at the middle or, where it was moved, within the object."""
    for found in starts:
        x, R = palm(scene, found.grasp.q)
        z = R[:, 2]
        lever = np.array(scene.position) - x
        assert lever @ z > 0.0 and lever[0] >= 0.0
        aside = lever[0] * z[1] - lever[1] * z[0]
        assert abs(aside) < POSE_TOL
        height = lever[:2] @ z[:2] / (z[:2] @ z[:2]) * z[2] - lever[2]
        assert abs(height) < scene.object.height / 2.0
        assert np.abs((x - scene.position)[:2]).max() <= 0.18 + POSE_TOL


def test_one_seed_gives_bitwise_one_start(scene, starts):
    again = Scene(object=scene.object)
    for seed, found in list(zip(SEEDS, starts, strict=True))[:2]:
        other = first_touch(again, GeometricProbe(again), np.random.default_rng(seed))
        np.testing.assert_array_equal(other.grasp.q, found.grasp.q)
        np.testing.assert_array_equal(other.grasp.jacobian, found.grasp.jacobian)
        assert other.rejected == found.rejected


def test_different_seeds_give_different_starts(starts):
    q = np.array([found.grasp.q for found in starts])
    assert len(np.unique(q.round(6), axis=0)) == len(q)


def test_draws_fill_the_papers_ranges(scene, starts):
    """Postures as drawn, before touch turns any of them down."""
    rng, drawn, sides = np.random.default_rng(10), [], []
    for _ in range(40):
        told = Told(then=starts[0].grasp)
        first_touch(scene, told, rng)
        x, R = palm(scene, told.targets[0])
        drawn.append(posture(scene, told.targets[0]))
        sides.append(np.degrees(np.arctan2(R[1, 2], R[0, 2])))
        lever = np.array(scene.position) - x
        np.testing.assert_allclose(np.cross(lever, R[:, 2]), 0.0, atol=POSE_TOL)
        assert abs(R[2, 0]) < POSE_TOL  # the opposition axis is horizontal
    for angles, (low, high) in zip(np.transpose(drawn), [(10, 90), (30, 50)], strict=True):
        assert low - 0.02 <= angles.min() < low + 0.15 * (high - low)
        assert high - 0.15 * (high - low) < angles.max() <= high + 0.02
    assert -90.0 <= np.min(sides) < -60.0 and 60.0 < np.max(sides) <= 90.0


def test_the_palm_begins_where_the_fingers_barely_reach(scene, starts):
    """A whole number of advances from where it was drawn, out of touch of the object."""
    for side in (0.02, 0.12, 0.3):
        told = Told(then=starts[0].grasp)
        start = Start(elevation=(0.6, 0.6), offset=(side, side))
        first_touch(scene, told, np.random.default_rng(2), start)
        x, R = palm(scene, told.targets[0])
        distance = (np.array(scene.position) - x) @ R[:, 2]
        drawn = np.sqrt(2.0) * side / np.cos(0.6)
        steps = (drawn - distance) / start.advance
        assert abs(steps - round(steps)) < 2 * POSE_TOL / start.advance
        assert 0.15 < distance < 0.25


def test_draws_that_cannot_touch_are_counted(scene, starts):
    inside = Missed(Miss.INSIDE, "finger_1")
    for misses in range(3):
        told = Told(*[inside] * misses, then=starts[0].grasp)
        found = first_touch(scene, told, np.random.default_rng(0))
        assert len(told.targets) == misses + 1
        assert found.rejected >= misses  # postures beyond the arm's reach count as well
        assert found.grasp is starts[0].grasp


def test_while_the_fingers_do_not_reach_the_palm_comes_nearer(scene, starts):
    no_touch = Missed(Miss.NO_TOUCH, "finger_2")
    told = Told(*[no_touch] * 3, then=starts[0].grasp)
    found = first_touch(scene, told, np.random.default_rng(3))
    assert found.rejected == 0 and len(told.targets) == 4
    poses = [palm(scene, q) for q in told.targets]
    for (x, R), (x_next, R_next) in itertools.pairwise(poses):
        np.testing.assert_allclose(R_next, R, atol=2 * POSE_TOL)
        np.testing.assert_allclose(x_next - x, Start().advance * R[:, 2], atol=2 * POSE_TOL)


def test_a_posture_is_offered_with_the_fingers_open_and_inside_the_ranges(scene, starts):
    told = Told(then=starts[0].grasp)
    first_touch(scene, told, np.random.default_rng(4))
    robot = scene.articulated
    for (j,) in robot.flexion:
        assert told.targets[0][j] == robot.q_lower[j]
    assert robot.violation(told.targets[0]) == 0.0


# ---------------------------------------------------------------- out of reach


@pytest.mark.parametrize("position", [(3.0, 0.0, 0.2), (0.7, 0.0, 4.0)])
def test_an_object_out_of_reach_is_named_with_the_way_out(position):
    scene = Scene(position=position)
    with pytest.raises(ReachError, match=r"from none of 2 drawn.*cannot reach.*move the object"):
        first_touch(scene, GeometricProbe(scene), np.random.default_rng(0), Start(max_draws=2))


def test_a_posture_by_a_step_that_is_not_certified_is_none(scene, probe, monkeypatch):
    solve = HQP.solve
    monkeypatch.setattr(
        HQP, "solve", lambda *given: dataclasses.replace(solve(*given), certified=False)
    )
    with pytest.raises(ReachError, match=r"from none of 2 drawn.*cannot reach"):
        first_touch(scene, probe, np.random.default_rng(0), Start(max_draws=2))


def test_the_last_reason_is_told(scene):
    told = Told(then=Missed(Miss.INSIDE, "finger_2"))
    with pytest.raises(ReachError, match=r"began inside the object \(finger_2\)"):
        first_touch(scene, told, np.random.default_rng(0), Start(max_draws=3))


MISSES = [
    (Miss.NO_TOUCH, "take a larger one"),
    (Miss.INSIDE, "take a smaller one"),
    (Miss.OTHER_LINK, "take a smaller or taller object"),
    (Miss.OWN_LINK, "take a larger one"),
    (Miss.TABLE, "raise the object"),
    (Miss.STUCK, "move the object, or take another"),
]


@pytest.mark.parametrize(("reason", "remedy"), MISSES)
def test_a_set_up_that_cannot_work_says_so_early_with_the_remedy_that_fits(reason, remedy):
    """All draws fail for one kind of reason, whichever finger it is: 500 of them took minutes."""

    class Told:
        touches = 0

        def touch(self, q_target):
            self.touches += 1
            return Missed(reason, f"finger_{1 + self.touches % 3}")

    message = f"none of {ALIKE} drawn postures .*{reason.value} .*; .*{remedy}"
    with pytest.raises(ReachError, match=message) as told:
        first_touch(Scene("bhand"), Told(), np.random.default_rng(0), Start(advance=0.1))
    assert sum(told.value.reasons.values()) == ALIKE
    assert all(reason.value in why for why in told.value.reasons)


def test_draws_that_fail_for_several_reasons_go_on_to_the_last():
    class Told:
        touches = 0

        def touch(self, q_target):
            self.touches += 1
            return Missed((Miss.INSIDE, Miss.OWN_LINK)[self.touches == 7], "finger_1")

    start = Start(max_draws=ALIKE + 20)
    with pytest.raises(ReachError, match=f"none of {ALIKE + 20} .*take a smaller one") as told:
        first_touch(Scene("bhand"), Told(), np.random.default_rng(0), start)
    assert sorted(told.value.reasons.values()) == [1, ALIKE + 19]


def test_the_three_most_common_reasons_are_told_the_commonest_first():
    kinds = [Miss.INSIDE] * 4 + [Miss.OWN_LINK] * 2 + [Miss.STUCK] + [Miss.TABLE] * 3
    told = Told(*[Missed(kind, "finger_1") for kind in kinds])
    with pytest.raises(ReachError) as error:
        first_touch(Scene("bhand"), told, np.random.default_rng(0), Start(max_draws=10))
    reasons = str(error.value).partition("postures (")[2]
    assert [reason.partition(" (")[0] for reason in reasons.split("; ")[:3]] == [
        f"4 {Miss.INSIDE.value}",
        f"3 {Miss.TABLE.value}",
        f"2 {Miss.OWN_LINK.value}",
    ]
    assert Miss.STUCK.value not in str(error.value) and "take a smaller one" in str(error.value)


def test_a_start_after_many_draws_that_failed_alike_is_still_found(starts):
    scene, inside = Scene("bhand"), Missed(Miss.INSIDE, "finger_1")
    told = Told(*[inside] * (ALIKE - 1), then=starts[0].grasp)
    assert first_touch(scene, told, np.random.default_rng(0)).rejected == ALIKE - 1


def test_an_object_out_of_reach_is_said_after_few_draws():
    with pytest.raises(ReachError, match=f"none of {ALIKE} drawn .*{ALIKE} the arm cannot reach"):
        Trial(Scene(position=(3.0, 0.0, 0.2)), ForceTask()).run(0)


def test_why_no_start_was_found_survives_the_way_between_processes():
    error = pickle.loads(pickle.dumps(ReachError("none of 2", {"the arm cannot": 2})))
    assert (str(error), error.reasons) == ("none of 2", {"the arm cannot": 2})


@pytest.mark.parametrize("seed", SEEDS)
def test_a_hand_without_an_arm_is_placed_where_the_draw_says(seed):
    scene = Scene("bhand")
    found = Start().draw(scene, GeometricProbe, np.random.default_rng(seed))
    x, R = palm(found.scene, found.grasp.q)
    adduction, elevation = posture(found.scene, found.grasp.q)
    assert 10.0 <= adduction <= 90.0 and 30.0 - 1e-6 <= elevation <= 50.0 + 1e-6
    lever = np.array(scene.position) - x
    assert abs(lever[0] * R[1, 2] - lever[1] * R[0, 2]) < 1e-9  # it faces the object's axis
    again = GeometricProbe(found.scene).touch(found.grasp.q)
    np.testing.assert_allclose(again.positions, found.grasp.positions, atol=1e-8)


def test_by_default_a_start_is_the_papers():
    start = Start()
    np.testing.assert_allclose(np.degrees(start.adduction), [10.0, 90.0])
    np.testing.assert_allclose(np.degrees(start.elevation), [30.0, 50.0])
    assert start.offset == (-0.18, 0.18)
    assert (start.advance, start.max_draws) == (0.01, 500)
    assert Start(adduction=(0.5, 0.5)).adduction == (0.5, 0.5)  # one value is a range too


# ---------------------------------------------------------------- where the palm is

MIDDLE = np.array([0.5, -0.2, 0.3])


@pytest.mark.parametrize("heading", [-2.0, 0.4])
@pytest.mark.parametrize("elevation", [0.6, -0.1])
def test_a_palm_faces_a_point_above_the_middle_from_its_distance(heading, elevation):
    place = _Place(elevation, heading, 0.25, height=0.03)
    z = place.approach
    level = np.cos(elevation)
    due = [level * np.cos(heading), level * np.sin(heading), -np.sin(elevation)]
    np.testing.assert_allclose(z, due)
    np.testing.assert_allclose(place.position(MIDDLE) + 0.25 * z, [0.5, -0.2, 0.33])
    assert _Place(elevation, heading, 0.25).height == _Place(elevation, heading, 0.25).turn == 0.0


@pytest.mark.parametrize("turn", [0.0, 0.3, -1.2])
def test_a_palm_turns_about_its_approach_from_where_its_first_axis_is_level(turn):
    """Of both level directions, the one nearer to how the palm is turned already."""
    place = _Place(0.6, 0.4, 0.25, turn=turn)
    z, level = place.approach, np.array([-np.sin(0.4), np.cos(0.4), 0.0])
    for sign in (1.0, -1.0):
        R = place.rotation(np.column_stack([sign * (level + 0.5 * z), z, z]))
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
        np.testing.assert_allclose(R[:, 2], z)
        x = sign * level
        np.testing.assert_allclose(
            R[:, 0], np.cos(turn) * x + np.sin(turn) * np.cross(z, x), atol=1e-12
        )
    R = place.rotation(np.column_stack([z, level, z]))  # neither is nearer: still a rotation
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_fingers_reach_as_far_before_the_palm_as_the_worst_of_their_tips(scene):
    """The farthest that each gets while it closes, its radius counted."""
    robot = scene.articulated
    q = robot.opened(robot.home)
    p, R = robot.palm(q)
    ahead = [
        ((robot.centers(robot.opened(q, share)) - p) @ R)[:, 2] + robot.tip_radius
        for share in np.linspace(0.0, 1.0, 200)
    ]
    assert _reach(robot, q, 0) == pytest.approx(np.max(ahead, axis=0).min(), abs=1e-3)
    assert np.max(ahead, axis=0).min() - _reach(robot, q, 0) >= 0.0


def test_an_object_extends_as_far_as_its_farthest_geom():
    assert _extent(Scene(object=Cylinder(0.05, height=0.12))) == pytest.approx(np.hypot(0.05, 0.06))
    wide = _extent(Scene(object=Prism.regular(6, 0.05)))
    assert np.hypot(0.05, 0.06) <= wide < 0.2


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"adduction": (1.0, 0.5)}, r"Start.adduction must be a range \(low, high\)"),
        ({"elevation": (0.5, np.nan)}, "Start.elevation must be finite"),
        ({"advance": 0.0}, r"Start.advance \[m\] must be finite and above 0"),
        ({"max_draws": 0}, "Start.max_draws must be at least 1"),
    ],
)
def test_a_malformed_start_is_refused(setting, message):
    with pytest.raises(InputError, match=message):
        Start(**setting)


def test_a_hand_that_cannot_spread_as_drawn_says_so(scene, starts):
    start = Start(adduction=(4.0, 4.0), max_draws=1)
    with pytest.raises(ReachError, match="cannot spread as drawn"):
        first_touch(scene, Told(then=starts[0].grasp), np.random.default_rng(0), start)


def test_a_robot_without_an_adduction_joint_can_be_drawn_for(tmp_path):
    """The lift cannot turn the palm as drawn: out of reach, and no other failure."""
    scene = Scene(tiny_hand.write(tmp_path), Cylinder(0.02), (0.1, 0.1, 0.0))
    with pytest.raises(ReachError, match="cannot reach the drawn posture"):
        first_touch(scene, GeometricProbe(scene), np.random.default_rng(0), Start(max_draws=2))


# ---------------------------------------------------------------- awkward places to begin from

FACES = {  # how many contacts share one face, how many are on an edge
    "two contacts on one face": (2, 0),
    "three contacts on one face": (3, 0),
    "a finger on an edge": (1, 1),
    "two fingers on edges": (1, 2),
}


@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_starts_are_what_they_are_called(name):
    scene, grasp = begin(name)
    corners = np.array(scene.object.polygon)
    sides = np.roll(corners, -1, axis=0) - corners
    faces = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
    on = (grasp.normals[:, :2] @ faces.T > 1.0 - 1e-9).sum(axis=0)
    together, on_edges = FACES[name]
    assert on.max() == together and grasp.k - on.sum() == on_edges
    np.testing.assert_allclose(grasp.normals[:, 2], 0.0, atol=1e-6)
    assert grasp.other_links == ()


@pytest.mark.parametrize("name", AWKWARD)
def test_a_trial_may_begin_anywhere_and_stays_within_the_ranges(name):
    """Even where all normals are parallel, which is stationary for the force law."""
    scene, grasp = begin(name)
    stack = ForceTask() >> MomentTask() >> KinematicTask()
    record = Trial(scene, stack, probes=12, start=grasp).run(0)
    assert len(record.grasps) > 1
    assert max(row["limit_violation"] for row in record.rows) == 0.0


def test_a_draw_whose_arms_are_in_one_another_is_rejected():
    scene = Scene("umass_torso", Cylinder(0.2, 0.4), hand="palms")
    robot, rng = scene.articulated, np.random.default_rng(0)
    own = SelfClearance(robot, robot.description.clearance)
    good = first_touch(scene, GeometricProbe(scene), np.random.default_rng(1)).grasp
    assert not own.collisions(good.q)
    within = (rng.uniform(robot.q_lower, robot.q_upper) for _ in itertools.count())
    crossed = robot.grasp(next(q for q in within if own.collisions(q)), good.contacts)
    found = first_touch(scene, Told(crossed, then=good), np.random.default_rng(1))
    assert found.grasp is good and found.rejected == 1
    with pytest.raises(ReachError, match=r"are in one another\); move the object to"):
        first_touch(scene, Told(then=crossed), np.random.default_rng(1), start_of(robot))


def start_of(robot):
    """The starts that a robot describes for its hand."""
    return dataclasses.replace(Start(), **robot.description.hand.start)
