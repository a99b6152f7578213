"""The controller by itself: a pure function of what was felt, without scene or probe."""

import copy
import dataclasses
import itertools
import json
import re

import numpy as np
import pytest

from hqp_grasp.control.controller import Controller
from hqp_grasp.control.episode import MissPolicy
from hqp_grasp.control.forms import FORMS, Form, MemorylessForm, form_of
from hqp_grasp.control.limits import (
    ConfigurationLimit,
    StepLimit,
    VelocityLimit,
    cap_ratio,
)
from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Frame, Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.history import load_history, save_history
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask, stack_of
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Scene

PROBES = 6
MISSED = Missed(Miss.NO_TOUCH, "finger_2")


class Hand:
    """A probe that keeps where it was sent and what it felt."""

    def __init__(self, scene):
        self.inner, self.touches = GeometricProbe(scene), []

    def touch(self, q_target):
        felt = self.inner.touch(q_target)
        self.touches.append(Touch(q_target, felt))
        return felt


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def robot(scene):
    return scene.articulated


@pytest.fixture(scope="module")
def stack():
    return stack_of("fmk")


@pytest.fixture(scope="module")
def first(scene, stack):
    return Trial(scene, stack, probes=1).run((616, 0)).grasps[0]


def walk(controller, probe, history, touches):
    """The history after so many more touches."""
    history = list(history)
    for _ in range(touches):
        step = controller.step(history)
        history.append(Touch(step.q_target, probe.touch(step.q_target)))
    return history


@pytest.mark.parametrize("form", FORMS)
def test_a_loop_of_ones_own_goes_where_a_trial_goes_bit_for_bit(scene, robot, stack, first, form):
    hand = Hand(scene)
    Trial(scene, stack, probes=PROBES, form=form, start=first).run((616, 0), hand)
    controller = Controller(robot, stack, form, budget=PROBES + 1)
    own = walk(controller, GeometricProbe(scene), [Touch(first.q, first)], PROBES)
    for ours, theirs in zip(own[1:], hand.touches, strict=True):
        assert ours.q_target.tobytes() == theirs.q_target.tobytes()


def test_a_stored_history_is_continued_bit_for_bit(scene, robot, stack, first, tmp_path):
    probe = GeometricProbe(scene)
    whole = walk(Controller(robot, stack), probe, [Touch(first.q, first)], PROBES)
    for stop in range(1, PROBES):
        save_history(tmp_path / "history.json", whole[:stop])
        loaded = load_history(tmp_path / "history.json")
        resumed = walk(Controller(robot, stack), probe, loaded, PROBES + 1 - stop)
        assert [t.q_target.tobytes() for t in resumed] == [t.q_target.tobytes() for t in whole]


def test_a_stored_history_keeps_every_field_of_grasps_and_misses(first, tmp_path):
    sensed = dataclasses.replace(first.contacts[0], wrench=[0.1, 0.2, 1 / 3, 0.0, -0.0, 1e-300])
    grasp = dataclasses.replace(first, contacts=(sensed, *first.contacts[1:]), other_links=("l",))
    history = [Touch(first.q, grasp), Touch(first.q + 0.1, Missed(Miss.INSIDE, "finger_1"))]
    save_history(tmp_path / "h.json", history)
    back = load_history(str(tmp_path / "h.json"))
    assert back[1].felt == history[1].felt
    for name in ("q", "jacobian", "hessian", "coupling", "offset"):
        assert getattr(back[0].felt, name).tobytes() == getattr(grasp, name).tobytes()
    assert back[0].felt.other_links == ("l",)
    for one, other in zip(back[0].felt.contacts, grasp.contacts, strict=True):
        for field in dataclasses.fields(Contact):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
    (there,), (here,) = back[0].felt.frames, grasp.frames
    for field in dataclasses.fields(Frame):
        np.testing.assert_array_equal(getattr(there, field.name), getattr(here, field.name))


def test_a_history_from_before_grasps_had_groups_is_read(robot, stack, first, tmp_path):
    path = tmp_path / "h.json"
    save_history(path, [Touch(first.q, first)])
    older = json.loads(path.read_text())["touches"]
    del older[0]["felt"]["frames"]
    for contact in older[0]["felt"]["contacts"]:
        del contact["group"], contact["closing"]
    path.write_text(json.dumps(older))
    history = load_history(path)
    assert history[0].felt.frames == () and history[0].felt.contacts[0].closing is None
    step, now = (Controller(robot, stack).step(h) for h in (history, [Touch(first.q, first)]))
    assert step.q_target.tobytes() == now.q_target.tobytes()


def test_a_history_stored_with_a_field_that_contacts_no_longer_have_is_read(first, tmp_path):
    path = tmp_path / "h.json"
    save_history(path, [Touch(first.q, first)])
    older = json.loads(path.read_text())["touches"]  # without a checksum
    for contact in older[0]["felt"]["contacts"]:
        contact |= {"confidence": 0.9}
    path.write_text(json.dumps(older))
    (touch,) = load_history(path)
    np.testing.assert_array_equal(touch.felt.positions, first.positions)
    older[0]["felt"]["contacts"][0]["colour"] = "red"
    path.write_text(json.dumps(older))
    with pytest.raises(ResultsError, match=r"no history of touches.*colour"):
        load_history(path)


def test_a_history_whose_grasps_differ_in_contacts_is_refused(robot, stack, first, tmp_path):
    two = Grasp(first.q, first.contacts[:2], first.jacobian[:6])
    controller = Controller(robot, stack)
    for grasps in ((first, two), (two, first)):
        history = [Touch(first.q, grasp) for grasp in grasps]
        with pytest.raises(InputError, match=r"felt \d contacts, the first \d: is it of another"):
            controller.step(history)
        with pytest.raises(InputError, match=r"touch 1 felt \d contacts .*: a history is of one"):
            save_history(tmp_path / "h.json", history)
    save_history(tmp_path / "h.json", [Touch(first.q, first)])
    touches = json.loads((tmp_path / "h.json").read_text())["touches"]
    touches.append(json.loads(json.dumps(touches[0])))
    touches[1]["felt"]["contacts"][2]["name"] = "thumb"
    (tmp_path / "h.json").write_text(json.dumps(touches))
    with pytest.raises(ResultsError, match=r"no history of touches.*thumb"):
        load_history(tmp_path / "h.json")


def test_a_history_far_outside_the_ranges_is_refused_and_one_a_little_outside_is_not(
    robot, stack, first
):
    controller, width = Controller(robot, stack), robot.q_upper - robot.q_lower
    for share, sign in itertools.product((0.05, 1.1), (-1, 1)):
        q = np.array(first.q)
        end = robot.q_lower if sign < 0 else robot.q_upper
        q[-1] = end[-1] + sign * share * width[-1]
        felt = dataclasses.replace(first, q=q)
        for touch in (Touch(q, first), Touch(first.q, felt), Touch(q, Missed(Miss.STUCK, "a"))):
            if share > 1.0:
                with pytest.raises(InputError, match=f"{robot.joints[-1]} at .* its range is"):
                    controller.step([Touch(first.q, first), touch])
            else:
                controller.step([Touch(first.q, first), touch])


@pytest.mark.parametrize("spoil", ["digit", "key", "null", "cut", "deep", "huge"])
def test_a_damaged_history_is_told(first, tmp_path, spoil):
    path = tmp_path / "h.json"
    save_history(path, [Touch(first.q, first)])
    text = path.read_text()
    number = repr(float(first.q[0]))
    path.write_text(
        {
            "digit": text.replace(number, number[:-1] + str((int(number[-1]) + 1) % 10)),
            "key": text.replace("sha256", "sha257"),
            "null": re.sub('"[0-9a-f]{64}"', "null", text),
            "cut": text[:-1],
            "deep": "[" * 100_000,
            "huge": text.replace(number, "1" + "0" * 400),
        }[spoil]
    )
    with pytest.raises(ResultsError, match=r"h\.json is (damaged|no history of touches)"):
        load_history(path)


def test_a_history_that_is_not_there_or_cannot_be_written_is_named(first, tmp_path):
    with pytest.raises(ResultsError, match=r"nowhere\.json cannot be read: No such file"):
        load_history(tmp_path / "nowhere.json")
    with pytest.raises(ResultsError, match=r"h\.json cannot be written: No such file"):
        save_history(tmp_path / "no_folder" / "h.json", [Touch(first.q, first)])


def test_what_a_plan_says_of_itself_is_told_with_the_step(robot, stack, first):
    @dataclasses.dataclass(frozen=True)
    class Unsure(HQP):
        def solve(self, levels, warm=None):
            return dataclasses.replace(super().solve(levels, warm), certified=False)

    step = Controller(robot, stack, MemorylessForm(Unsure())).step([Touch(first.q, first)])
    np.testing.assert_allclose(step.q_target, first.q, atol=1e-12)
    assert step.reason == "the hand stays: no answer is certified"


def test_targets_are_within_the_ranges_and_steps_within_the_caps(scene, robot, stack, first):
    history = walk(Controller(robot, stack), GeometricProbe(scene), [Touch(first.q, first)], PROBES)
    for before, after in itertools.pairwise(history):
        assert robot.violation(after.q_target) == 0.0
        assert np.abs(after.q_target - before.felt.q).max() <= StepLimit().joint * (1 + 1e-9)


def test_misses_shorten_the_step_then_the_controller_gives_up(robot, stack, first):
    controller = Controller(robot, stack, "memoryless", landing=False)
    history = [Touch(first.q, first)]
    steps = []
    for share in MissPolicy().shares:
        step = controller.step(history)
        assert step.share == share
        steps.append(step.q_target - first.q)
        history.append(Touch(step.q_target, MISSED))
    for share, x in zip(MissPolicy().shares, steps, strict=True):
        np.testing.assert_allclose(x, share * steps[0], atol=1e-14)
    last = controller.step(history)
    assert last.q_target is None and last.plan is None
    assert last.reason == (
        "3 misses from one grasp, the last: a finger closed without touching (finger_2)"
    )


@pytest.mark.parametrize("reason", Miss)
def test_every_miss_has_a_reaction_and_an_end(robot, stack, first, reason):
    controller = Controller(robot, stack, "memoryless", landing=False)
    history, told = [Touch(first.q, first)], []
    plain = controller.step(history)
    assert plain.reason == ""
    while len(told) < 10:
        history.append(Touch(plain.q_target, Missed(reason, "finger_2")))
        step = controller.step(history)
        told.append(step.reason)
        if step.q_target is None:
            break
        if reason in (Miss.SENSOR, Miss.STUCK):
            np.testing.assert_array_equal(step.q_target, plain.q_target)
        elif reason in (Miss.OTHER_LINK, Miss.TABLE, Miss.INSIDE):
            palms = [robot.palm(q) for q in (first.q, step.q_target)]
            back = (palms[0][0] - palms[1][0]) @ palms[0][1][:, 2]
            assert back > 0.01 * len(told) - 2e-3  # at least, to first order
        else:
            share = MissPolicy().shares[len(told)]
            np.testing.assert_allclose(
                step.q_target - first.q, share * (plain.q_target - first.q), atol=1e-14
            )
    *reactions, last = told
    assert last.endswith(f"misses from one grasp, the last: {reason.value} (finger_2)")
    if reason in (Miss.SENSOR, Miss.STUCK):
        assert reactions == ["the same again"] * 3
    elif reason in (Miss.OTHER_LINK, Miss.TABLE, Miss.INSIDE):
        assert reactions == [f"palm back by {10 * i} mm" for i in range(1, 6)]
    else:
        assert reactions == ["0.5 of the step", "0.25 of the step"]


@pytest.mark.parametrize("reason", Miss)
def test_the_first_touch_is_tried_again_where_what_ails_it_may_pass(robot, stack, first, reason):
    controller, missed = Controller(robot, stack), Touch(first.q, Missed(reason, "finger_1"))
    step = controller.step([missed])
    if reason in (Miss.SENSOR, Miss.STUCK, Miss.BLOCKED, Miss.LOST, Miss.UNCLEAR):
        np.testing.assert_array_equal(step.q_target, first.q)
        assert step.reason == "the same again"
    else:
        assert step.reason == "20 mm beside"


def test_where_the_first_touch_finds_nothing_it_is_tried_beside_all_around(robot, stack, first):
    """The palm moves level and keeps its direction; fingers, and the object's place, stay."""
    controller, history = Controller(robot, stack), [Touch(first.q, MISSED)]
    p, R = robot.palm(first.q)
    ways = []
    while (step := controller.step(history)).q_target is not None:
        place, turned = robot.palm(step.q_target)
        np.testing.assert_allclose(turned, R, atol=0.02)
        assert robot.violation(step.q_target) == 0.0
        ways.append(place - p)
        history.append(Touch(step.q_target, MISSED))
    assert "begin where the hand touches" in step.reason
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 0.02, atol=1e-4)
    np.testing.assert_allclose(np.array(ways)[:, 2], 0.0, atol=1e-4)
    angles = np.sort(np.degrees(np.arctan2(*np.array(ways)[:, 1::-1].T)) % 360.0)
    np.testing.assert_allclose(np.diff(angles), 45.0, atol=1.0)


def test_a_search_keeps_to_ranges_narrower_than_the_robots(robot, stack, first):
    narrow = copy.copy(robot)
    for name, room in (("q_lower", -0.01), ("q_upper", 0.01)):
        object.__setattr__(narrow, name, first.q + room)
    missed = Touch(first.q, MISSED)
    step = Controller(robot, stack.within(ConfigurationLimit(narrow))).step([missed])
    free = Controller(robot, stack).step([missed])
    assert np.abs(step.q_target - first.q).max() <= 0.01 + 1e-12
    assert np.abs(free.q_target - first.q).max() > 0.02


def test_a_hand_that_nothing_carries_does_not_search(first):
    robot = Scene(robot="bhand").articulated
    q = robot.home
    step = Controller(robot, stack_of("fmk")).step([Touch(q, MISSED)])
    assert step.q_target is None and "begin where the hand touches" in step.reason


def test_a_sensor_that_comes_back_costs_no_share_of_the_step(robot, stack, first):
    history = [Touch(first.q, first), *[Touch(first.q, Missed(Miss.SENSOR, "finger_1"))] * 2]
    shorter = Controller(robot, stack).step([*history, Touch(first.q, MISSED)])
    assert shorter.share == MissPolicy().shares[1] and shorter.reason == "0.5 of the step"


def test_a_touch_after_misses_begins_anew(robot, stack, first):
    controller = Controller(robot, stack)
    history = [Touch(first.q, MISSED), Touch(first.q, MISSED), Touch(first.q, first)]
    assert controller.step(history).share == 1.0


def test_a_spent_budget_ends_the_run(robot, stack, first):
    controller = Controller(robot, stack, budget=2)
    history = [Touch(first.q, first)]
    assert controller.step(history).q_target is not None
    spent = controller.step(history * 2)
    assert spent.q_target is None and spent.reason == "the budget of 2 touches is spent"


def test_caps_stay_when_another_limit_is_named(robot, first):
    """Only caps replace caps: adding a range must not let the arm go."""
    history = [Touch(first.q, first)]
    stack = stack_of("fmk")
    plain = Controller(robot, stack).step(history)
    ranged = Controller(robot, stack.within(ConfigurationLimit(robot))).step(history)
    np.testing.assert_array_equal(plain.q_target, ranged.q_target)
    wide = VelocityLimit(np.full(robot.n, 1.0), 2.0)
    capped = Controller(robot, stack.within(wide)).stack.limits
    assert [type(limit) for limit in capped] == [VelocityLimit, ConfigurationLimit]


def test_one_law_is_a_stack_too(robot, first):
    step = Controller(robot, ForceTask()).step([Touch(first.q, first)])
    assert np.isfinite(step.q_target).all()


@pytest.mark.parametrize(
    ("history", "message"),
    [
        ([], "the history is empty"),
        ([1], "a history holds Touch values; got 1"),
        ([Touch(np.zeros(3), MISSED)], r"a touch has 3 joints, Robot\('wam_bhand'\) has 11"),
    ],
)
def test_a_malformed_history_is_refused(robot, stack, history, message):
    with pytest.raises(InputError, match=message):
        Controller(robot, stack).step(history)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"form": "papr"},
            "unknown form 'papr'; choose one of: hierarchy, memoryless, paper-hierarchy, ",
        ),
        ({"budget": 0}, "budget must be at least 1"),
        ({"robot": "wam_bhand"}, "must be a Robot"),
        ({"stack": "fmk"}, "'fmk' is no control law"),
        ({"form": "paper", "stack": KinematicTask() >> ForceTask()}, "kinematic law last"),
    ],
)
def test_malformed_settings_are_refused(robot, stack, arguments, message):
    with pytest.raises(InputError, match=message):
        Controller(**({"robot": robot, "stack": stack} | arguments))


def test_a_touch_holds_finite_joints_and_what_was_felt(first):
    with pytest.raises(InputError, match="must be finite"):
        Touch(np.full(11, np.nan), MISSED)
    with pytest.raises(InputError, match="must be a Grasp or a Missed"):
        Touch(np.zeros(11), None)
    with pytest.raises(InputError, match="has 3 joints, its grasp 11"):
        Touch(np.zeros(3), first)


def test_a_robots_grasp_is_the_one_that_its_probe_feels(robot, first):
    felt = [Contact(c.position, c.normal) for c in first.contacts]
    again = robot.grasp(first.q, felt)
    names = [point.name for point in robot.description.contact_points]
    closing = dict(zip(names, robot.closing, strict=True))
    for name in ("q", "jacobian", "hessian", "coupling", "offset", "positions", "normals"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for one, other in zip(again.contacts, first.contacts, strict=True):
        assert (one.name, one.body, one.flexion) == (other.name, other.body, other.flexion)
        assert one.group == "hand"
        np.testing.assert_array_equal(one.closing, closing[one.name])
    (frame,) = again.frames
    position, rotation = robot.palm(first.q)
    assert frame.name == "hand"
    np.testing.assert_array_equal(frame.position, position)
    np.testing.assert_array_equal(frame.rotation, rotation)
    np.testing.assert_array_equal(frame.jacobian, robot.palm_jacobian(first.q))
    with pytest.raises(InputError, match=r"touches with 3 points .*got 2 contacts"):
        robot.grasp(first.q, felt[:2])


def test_a_form_of_ones_own_stands_in_the_place_of_a_name(robot, first):
    class Still(Form):
        def plan(self, stack, episode):
            plan = form_of("clipped").plan(stack, episode)
            return dataclasses.replace(plan, x=np.zeros(len(plan.x)))

    step = Controller(robot, MomentTask(), form=Still()).step([Touch(first.q, first)])
    np.testing.assert_allclose(step.q_target, first.q, atol=1e-12)


def test_the_history_of_something_else_is_named(tmp_path):
    path = tmp_path / "other.json"
    for text in ('{"a": 1}', "[1]", '[{"felt": {"contacts": [[1]]}, "q_target": [0]}]', "", "\xff"):
        path.write_text(text, encoding="latin-1")
        with pytest.raises(ResultsError, match="no history of touches"):
            load_history(path)


def test_a_hand_that_is_lost_begins_again_from_its_first_grasp(scene, robot, stack, first):
    controller = Controller(robot, stack)
    history = walk(controller, GeometricProbe(scene), [Touch(first.q, first)], 3)
    last = next(touch.felt for touch in reversed(history) if isinstance(touch.felt, Grasp))
    again = controller.step(history)
    while "first grasp again" not in again.reason:
        history.append(Touch(again.q_target, MISSED))
        again = controller.step(history)
        assert len(history) < 20
    np.testing.assert_array_equal(again.via[-1], first.q)
    assert cap_ratio(again.q_target - first.q, controller.stack, first) <= 1.0 + 1e-6
    assert cap_ratio(again.q_target - last.q, controller.stack, last) > 1.0


def test_a_hand_that_is_lost_from_its_first_grasp_again_gives_up(robot, stack, first):
    controller, history = Controller(robot, stack), [Touch(first.q, first)]
    told = []
    while (step := controller.step(history)).q_target is not None:
        told.append(step.reason)
        history.append(Touch(step.q_target, MISSED))
        assert len(history) < 40
    assert sum("first grasp again" in reason for reason in told) == 1
    assert "misses from one grasp" in step.reason


def test_a_palm_that_withdrew_in_vain_takes_the_way_again(robot, stack, first):
    """A retreat that ends in a miss does not stay: the next step is shorter instead."""
    controller = Controller(robot, stack, "memoryless", landing=False)
    plain = controller.step([Touch(first.q, first)])
    misses = [Missed(Miss.OTHER_LINK, "palm"), MISSED]
    history = [Touch(first.q, first), *(Touch(plain.q_target, miss) for miss in misses)]
    assert controller.step(history[:2]).reason == "palm back by 10 mm"
    step = controller.step(history)
    assert step.reason == "0.5 of the step"
    np.testing.assert_allclose(
        step.q_target - first.q, 0.5 * (plain.q_target - first.q), atol=1e-14
    )
