"""Starting postures: the paper's ranges, one seed one start, and an object out of reach."""

import dataclasses
import itertools

import numpy as np
import pytest
import tiny_hand

from hqp_grasp.errors import InputError, ReachError
from hqp_grasp.experiments.start import Start
from hqp_grasp.grasp import Grasp, Miss, Missed
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Cylinder, Prism, Scene

SEEDS = range(3)
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


def test_a_touch_with_another_link_or_on_the_top_is_no_start(scene, starts):
    good = starts[0].grasp
    crowded = dataclasses.replace(good, other_links=("f2_distal",))
    top = dataclasses.replace(good.contacts[1], normal=[0.0, 0.0, 1.0])
    above = dataclasses.replace(good, contacts=(good.contacts[0], top, good.contacts[2]))
    told = Told(crowded, above, then=good)
    found = first_touch(scene, told, np.random.default_rng(5))
    assert found.grasp is good
    assert found.rejected >= 2 and len(told.targets) == 3


def test_adduction_and_elevation_lie_in_the_papers_ranges(scene, starts):
    slack = np.degrees(POSE_TOL)
    for found in starts:
        adduction, elevation = posture(scene, found.grasp.q)
        assert 10.0 - slack <= adduction <= 90.0 + slack
        assert 30.0 - slack <= elevation <= 50.0 + slack


def test_the_palm_faces_the_middle_of_the_object_from_the_robots_side(scene, starts):
    for found in starts:
        x, R = palm(scene, found.grasp.q)
        z = R[:, 2]
        lever = np.array(scene.position) - x
        miss = np.linalg.norm(lever - (lever @ z) * z)
        assert miss < POSE_TOL * (1.0 + np.linalg.norm(lever))
        assert lever @ z > 0.0 and lever[0] >= 0.0
        assert abs(R[2, 0]) < POSE_TOL  # the opposition axis is horizontal
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
    rng, drawn, beside = np.random.default_rng(10), [], []
    for _ in range(40):
        told = Told(then=starts[0].grasp)
        first_touch(scene, told, rng)
        drawn.append(posture(scene, told.targets[0]))
        beside.append(palm(scene, told.targets[0])[0][:2] - scene.position[:2])
    for angles, (low, high) in zip(np.transpose(drawn), [(10, 90), (30, 50)], strict=True):
        assert low - 0.02 <= angles.min() < low + 0.15 * (high - low)
        assert high - 0.15 * (high - low) < angles.max() <= high + 0.02
    forward, sideways = np.transpose(beside)
    assert forward.min() >= -0.18 - POSE_TOL and forward.max() <= POSE_TOL
    assert -0.18 - POSE_TOL <= sideways.min() < -0.1 and 0.1 < sideways.max() <= 0.18 + POSE_TOL


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


def test_the_last_reason_is_told(scene):
    told = Told(then=Missed(Miss.INSIDE, "finger_2"))
    with pytest.raises(ReachError, match=r"began inside the object \(finger_2\)"):
        first_touch(scene, told, np.random.default_rng(0), Start(max_draws=3))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_hand_without_an_arm_is_placed_where_the_draw_says(seed):
    scene = Scene("bhand")
    found = Start().draw(scene, GeometricProbe, np.random.default_rng(seed))
    x, R = palm(found.scene, found.grasp.q)
    adduction, elevation = posture(found.scene, found.grasp.q)
    assert 10.0 <= adduction <= 90.0 and 30.0 - 1e-6 <= elevation <= 50.0 + 1e-6
    lever = np.array(scene.position) - x
    np.testing.assert_allclose(np.cross(lever, R[:, 2]), 0.0, atol=1e-9)
    np.testing.assert_allclose(R[2, 0], 0.0, atol=1e-9)  # the opposition axis is horizontal
    again = GeometricProbe(found.scene).touch(found.grasp.q)
    np.testing.assert_allclose(again.positions, found.grasp.positions, atol=1e-8)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"adduction": (1.0, 0.5)}, r"Start.adduction must be a range \(low, high\)"),
        ({"elevation": (0.5, np.nan)}, "Start.elevation must be a range"),
        ({"advance": 0.0}, "an advance above 0"),
        ({"max_draws": 0}, "at least 1 draw"),
    ],
)
def test_a_malformed_start_is_refused(setting, message):
    with pytest.raises(InputError, match=message):
        Start(**setting)


def test_a_robot_without_an_adduction_joint_can_be_drawn_for(tmp_path):
    """The lift cannot turn the palm as drawn: out of reach, and no other failure."""
    scene = Scene(tiny_hand.write(tmp_path), Cylinder(0.02), (0.1, 0.1, 0.0))
    with pytest.raises(ReachError, match="cannot reach the drawn posture"):
        first_touch(scene, GeometricProbe(scene), np.random.default_rng(0), Start(max_draws=2))
