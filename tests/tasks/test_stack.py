"""Stacks: how laws and limits are composed, and the hierarchy that comes of it."""

import dataclasses

import mink
import numpy as np
import pytest

from hqp_grasp.control.limits import ConfigurationLimit, StepLimit, VelocityLimit
from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.tasks import (
    ContactTask,
    ForceTask,
    KinematicTask,
    MinkLimit,
    MomentTask,
    PostureTask,
    stack_of,
)
from hqp_grasp.tasks.stack import Stack
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Cylinder, Scene

F, M, K, P = ForceTask(), MomentTask(), KinematicTask(), PostureTask()
POSTURE = (0.62, 1.12, -0.73, 1.96, 0.63, -0.41, 0.49, 0.21, 1.01, 0.99, 0.98)


@pytest.fixture(scope="module")
def scene():
    return Scene(object=Cylinder(0.05, height=0.4))


@pytest.fixture(scope="module")
def grasp(scene):
    felt = GeometricProbe(scene).touch(np.array(POSTURE))
    assert isinstance(felt, Grasp)
    return felt


def names(levels):
    return [level.name for level in levels]


def assert_levels_equal(one, two):
    assert names(one) == names(two)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.A, b.A)
        np.testing.assert_array_equal(a.lower, b.lower)
        np.testing.assert_array_equal(a.upper, b.upper)


# ---------------------------------------------------------------- composition


def test_left_comes_first():
    assert (F >> M >> K).priorities == ((F,), (M,), (K,))
    assert (K >> M >> F).priorities == ((K,), (M,), (F,))
    assert (F >> M >> K).name == "force ▷ moment ▷ kinematic"


def test_composing_in_two_halves_is_composing_in_one_go():
    assert (F >> M) >> (K >> P) == F >> M >> K >> P == F >> (M >> (K >> P))


def test_a_sum_shares_one_level():
    assert (F + M).priorities == ((F, M),)
    assert (F >> M + K).priorities == ((F,), (M, K))  # + binds closer than >>
    assert ((F >> M) + K).priorities == ((F,), (M, K))
    assert (F + (M + K)).priorities == ((F, M, K),) == (F + M + K).priorities
    assert (F >> M + K).name == "force ▷ moment + kinematic"


def test_composing_leaves_the_parts_as_they_were():
    base = F >> M
    base >> K, base + K, base.within(StepLimit())
    assert base == F >> M and base.limits == ()
    with pytest.raises(dataclasses.FrozenInstanceError):
        base.limits = (StepLimit(),)


def test_limits_of_both_sides_are_kept():
    cap, tight = StepLimit(), StepLimit(joint=0.1)
    assert ((F.__rshift__(M)).within(cap) >> (K >> P).within(tight)).limits == (cap, tight)
    assert (Stack.of(F).within(cap) + Stack.of(M).within(tight)).limits == (cap, tight)
    assert (F >> M).within(cap, tight) == (F >> M).within(cap).within(tight)


def test_contacts_are_held_unless_either_side_lets_go():
    free = Stack(((F,),), hold_contacts=False)
    held = Stack.of(M)
    assert (held >> K).hold_contacts
    assert not (free >> held).hold_contacts
    assert not (held >> free).hold_contacts
    assert not (free + held).hold_contacts
    assert not (held + free).hold_contacts


@pytest.mark.parametrize("other", [3, None, "m", ForceTask, StepLimit()], ids=str)
def test_only_tasks_and_stacks_compose(other):
    for left in (F, F >> M):
        with pytest.raises(InputError, match="is no control law"):
            left >> other
        with pytest.raises(InputError, match="is no control law"):
            left + other


def test_a_stack_of_several_levels_shares_none():
    with pytest.raises(InputError, match="one priority"):
        F + (M >> K)


@pytest.mark.parametrize("limit", [3, None, F, StepLimit, mink.VelocityLimit], ids=str)
def test_only_limits_limit(limit):
    with pytest.raises(InputError, match="is no limit of hqp_grasp or mink"):
        (F >> M).within(limit)


@pytest.mark.parametrize("priorities", [(), ((),), ((F,), ()), (F, M), ((3,),)], ids=str)
def test_a_stack_holds_a_law_at_every_priority(priorities):
    with pytest.raises(InputError):
        Stack(priorities)


# ---------------------------------------------------------------- letters


@pytest.mark.parametrize(
    ("letters", "laws"), [("fmk", (F, M, K)), ("f", (F,)), ("kf", (K, F)), ("fm", (F, M))]
)
def test_letters_name_the_laws_in_their_order(letters, laws):
    assert stack_of(letters).priorities == tuple((law,) for law in laws)


def test_the_kinematic_error_can_be_chosen_with_the_letters():
    assert stack_of("k", "eq7") == Stack.of(KinematicTask(error="eq7"))
    with pytest.raises(InputError, match=r"unknown KinematicTask error 'eq8'.*angle, eq7"):
        stack_of("fmk", "eq8")


@pytest.mark.parametrize("letters", ["", "x", "fmx", "ff", "fmkf", "FMK", "f m", None, 3])
def test_unknown_letters_come_with_the_known_ones(letters):
    with pytest.raises(InputError, match=r"f \(force\), m \(moment\), k \(kinematic\)"):
        stack_of(letters)


# ---------------------------------------------------------------- the hierarchy


def test_levels_stand_in_the_order_of_the_paper(grasp):
    levels = (F >> M >> K).levels(grasp)
    assert names(levels) == ["contact", "force", "moment", "kinematic"]
    for level, task in zip(levels, (ContactTask(), F, M, K), strict=True):
        A, b = task.rows(grasp)
        np.testing.assert_array_equal(level.A, A)
        np.testing.assert_array_equal(level.lower, b)
        np.testing.assert_array_equal(level.upper, b)


def test_holding_contacts_can_be_turned_off(grasp):
    free = Stack(((F,), (M,)), hold_contacts=False)
    assert names(free.levels(grasp)) == ["force", "moment"]


def test_laws_at_one_priority_are_rows_of_one_level(grasp):
    levels = (F >> M + K).levels(grasp)
    assert names(levels) == ["contact", "force", "moment + kinematic"]
    A, b = zip(M.rows(grasp), K.rows(grasp), strict=True)
    np.testing.assert_array_equal(levels[2].A, np.concatenate(A))
    np.testing.assert_array_equal(levels[2].lower, np.concatenate(b))
    np.testing.assert_array_equal(levels[2].upper, np.concatenate(b))


def test_caps_come_before_ranges_before_clearances_before_contacts_before_laws(scene, grasp):
    """In whatever order they were given."""
    robot, model = scene.articulated, scene.model
    clearance = mink.CollisionAvoidanceLimit(
        model, [(["f3_distal"], ["object"])], collision_detection_distance=0.1
    )
    limits = [
        clearance,
        ConfigurationLimit(robot),
        VelocityLimit(robot.velocity, 0.2),
        StepLimit(),
        mink.ConfigurationLimit(model),
        mink.VelocityLimit(model, {"wam_j1": 1.0}),
    ]
    levels = (F >> M).within(*limits).levels(grasp)
    assert names(levels) == [
        "velocity + step + VelocityLimit",
        "range + ConfigurationLimit",
        "CollisionAvoidanceLimit",
        "contact",
        "force",
        "moment",
    ]
    assert all(level.is_inequality for level in levels[:3])
    again = (F >> M).within(*limits[::-1]).levels(grasp)
    assert [set(n.split(" + ")) for n in names(again)] == [
        set(n.split(" + ")) for n in names(levels)
    ]


def test_the_hierarchy_is_its_limits_then_its_laws(scene, grasp):
    stack = (F >> M).within(StepLimit(), ConfigurationLimit(scene.articulated))
    assert_levels_equal(stack.levels(grasp), stack.limit_levels(grasp) + stack.law_levels(grasp))
    assert names(stack.limit_levels(grasp)) == ["step", "range"]
    assert (F >> M).limit_levels(grasp) == []
    assert_levels_equal((F >> M).law_levels(grasp), stack.law_levels(grasp))


def test_minks_limits_are_accepted_as_they_are(scene):
    limit = mink.ConfigurationLimit(scene.model)
    (taken,) = Stack.of(F).within(limit).limits
    assert isinstance(taken, MinkLimit) and taken.limit is limit


def test_the_same_grasp_gives_bitwise_the_same_levels(scene, grasp):
    stack = (F >> M >> K).within(StepLimit(), ConfigurationLimit(scene.articulated))
    assert_levels_equal(stack.levels(grasp), stack.levels(grasp))


def test_a_lower_law_never_disturbs_a_higher_one(scene, grasp):
    """The residual of each level is what it is without the levels below."""
    limits = (StepLimit(), ConfigurationLimit(scene.articulated))
    whole = (F >> M >> K).within(*limits).levels(grasp)
    full = HQP().solve(whole)
    for count in range(3, len(whole)):
        part = HQP().solve(whole[:count])
        for a, b in zip(part.levels, full.levels, strict=False):
            np.testing.assert_allclose(
                np.linalg.norm(a.residual), np.linalg.norm(b.residual), atol=1e-9
            )


def test_held_contacts_do_not_move_along_their_normals(scene, grasp):
    stack = (F >> M >> K).within(StepLimit())
    x = HQP().solve(stack.levels(grasp)).x
    motion = (grasp.jacobian @ x).reshape(3, 3)
    np.testing.assert_allclose((grasp.normals * motion).sum(axis=1), 0.0, atol=1e-10)


def test_a_law_that_lacks_what_it_needs_says_so_when_the_levels_are_asked_for():
    bare = Grasp(np.zeros(2), [Contact(np.zeros(3), [0, 0, 1.0], flexion=(0,))], np.ones((3, 2)))
    assert names((F >> M).levels(bare)) == ["contact", "force", "moment"]
    with pytest.raises(InputError, match="second derivatives"):
        (F >> K).levels(bare)


# ---------------------------------------------------------------- laws of one's own


@dataclasses.dataclass(frozen=True)
class OwnTask(ForceTask):
    """The force law, its answers changed by a rule."""

    change: str = "none"

    def error(self, grasp):
        f = super().error(grasp)
        if self.change == "raises":
            return f[7]
        return {"column": f[:, None], "short": f[:2], "list": f.tolist()}.get(self.change, f)

    def jacobian(self, grasp):
        J = super().jacobian(grasp)
        return {"transposed": J.T, "list": J.tolist()}.get(self.change, J)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("column", r"the law 'own': error must have shape \(r,\) .*got \(3, 1\) and \(3, 11\)"),
        ("short", r"'own': .* \(2,\) and jacobian \(2, 11\); got \(2,\) and \(3, 11\)"),
        ("transposed", r"'own': .* \(3,\) and jacobian \(3, 11\); got \(3,\) and \(11, 3\)"),
    ],
)
def test_a_wrong_shape_names_the_law_and_the_right_one(grasp, change, message):
    with pytest.raises(InputError, match=message):
        (M >> OwnTask(change=change)).levels(grasp)
    if change == "column":
        with pytest.raises(InputError, match=r"'own': error must have shape \(r,\); got \(3, 1\)"):
            (M >> OwnTask(change=change)).errors(grasp)


def test_what_a_law_raises_says_which_law_it_was(grasp):
    stack = M >> OwnTask(change="raises")
    for ask in (stack.levels, stack.errors):
        with pytest.raises(IndexError, match="out of bounds") as caught:
            ask(grasp)
        assert caught.value.__notes__ == ["raised by the law 'own' (OwnTask)"]


def test_a_law_may_answer_with_lists(grasp):
    (level,) = Stack.of(OwnTask(change="list")).law_levels(grasp)[1:]
    np.testing.assert_array_equal(level.A, OwnTask().jacobian(grasp))
    errors = (M >> OwnTask(change="list")).errors(grasp)
    assert list(errors) == ["moment", "own"]
    np.testing.assert_array_equal(errors["own"], F.error(grasp))


@pytest.mark.parametrize("compose", [lambda: F >> M >> F, lambda: F + ForceTask(radius=0.1)])
def test_two_laws_of_one_name_are_refused(compose):
    with pytest.raises(InputError, match=r"two laws .* are named 'force'.*a `name` of its own"):
        compose()


def test_a_subclass_with_a_name_of_its_own_is_another_law():
    class FarForceTask(ForceTask):
        name = "far"

    assert (F >> FarForceTask(radius=0.1)).name == "force ▷ far"
