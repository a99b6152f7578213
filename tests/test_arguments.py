"""Wrong arguments: all that is exported says by name what is wrong, and takes numpy's numbers."""

import dataclasses
import inspect
import json
import re
from collections.abc import Callable
from contextlib import suppress
from types import UnionType
from typing import Any, Protocol, Union, get_args, get_origin, get_type_hints

import mink
import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.control.forces import NetForce
from hqp_grasp.errors import flag, not_negative, number, one_of, positive, whole
from hqp_grasp.world.imperfections import Fault

SCENE, ARM = hg.Scene("bhand"), hg.Scene("wam_bhand")
ROBOT = SCENE.articulated
STACK = hg.ForceTask() >> hg.MomentTask()
CONTACT = {"position": np.zeros(3), "normal": [1.0, 0.0, 0.0]}
GRASP = {"q": np.zeros(2), "contacts": (hg.Contact(**CONTACT),), "jacobian": np.zeros((3, 2))}
SQUARE = ((0.03, 0.03), (-0.03, 0.03), (-0.03, -0.03), (0.03, -0.03))
FOUR = np.ones(4)
HAND = hg.SimulatedHand(SCENE)
CONFIGURATION = mink.Configuration(SCENE.model)
POSTURE = mink.PostureTask(SCENE.model, cost=1.0)
POSTURE.set_target(CONFIGURATION.q)

# A sound call of everything that is built or called with a user's values, not of what only answers.
CALLS: dict[Callable[..., Any], dict[str, Any]] = {
    hg.AlignTask: {},
    hg.Body: {"file": "robots/bhand/bhand.xml"},
    hg.ClearanceLimit: {"robot": ROBOT},
    hg.ClippedForm: {},
    hg.ConfigurationLimit: {"robot": ROBOT},
    hg.Contact: CONTACT,
    hg.ContactTask: {},
    hg.Controller: {"robot": ROBOT, "stack": STACK},
    hg.Cylinder: {"radius": 0.05},
    hg.DriverLimits: dict.fromkeys(("upper", "speed", "torque"), FOUR)
    | {"lower": -FOUR, "force": 1.0, "watchdog": 1.0},
    hg.ForceTask: {},
    hg.Frame: {
        "name": "palm",
        "position": np.zeros(3),
        "rotation": np.eye(3),
        "jacobian": np.zeros((6, 2)),
    },
    hg.Forces: {"priorities": ((NetForce(),),)},
    hg.GeometricProbe: {"scene": SCENE},
    hg.Grasp: GRASP,
    hg.Grip: {"robot": ROBOT, "force": 0.25},
    hg.HQP: {},
    hg.HierarchyForm: {},
    hg.Hold: {"grip": hg.Grip(ROBOT)},
    hg.Imperfections: {},
    hg.Judge: {"scene": SCENE},
    hg.KinematicTask: {},
    hg.Level: {"A": np.eye(2), "lower": -np.ones(2), "upper": np.ones(2)},
    hg.Level.equal: {"A": np.eye(2), "b": np.ones(2)},
    hg.MemorylessForm: {},
    hg.MinkLimit: {"limit": mink.ConfigurationLimit(SCENE.model)},
    hg.MinkTask: {"task": POSTURE},
    hg.Missed: {"reason": hg.Miss.STUCK, "where": "finger"},
    hg.MomentTask: {},
    hg.Noise: {},
    hg.NoisyProbe: {
        "probe": hg.GeometricProbe(SCENE),
        "robot": ROBOT,
        "noise": hg.Noise(),
        "rng": np.random.default_rng(0),
    },
    hg.PaperForm: {},
    hg.PhysicalProbe: {"driver": HAND, "robot": ROBOT},
    hg.Physics: {},
    hg.Pick: {"trial": hg.Trial(ARM, STACK, probe=hg.Physics(support="pedestal"))},
    hg.PostureTask: {},
    hg.Prism: {"polygon": SQUARE},
    hg.Prism.regular: {"sides": 6, "side": 0.03},
    hg.Projection: {},
    hg.Readings: {
        "time": np.zeros(1),
        "q": np.zeros((1, 4)),
        "velocity": np.zeros((1, 4)),
        "wrench": np.zeros((1, 3, 6)),
        "touched": np.zeros(3, dtype=bool),
        "stalled": np.zeros(3, dtype=bool),
    },
    hg.Rig: {
        "driver": HAND,
        "robot": ROBOT,
        "free": np.zeros((2, 4)),
        "open": np.zeros(4),
        "normals": np.eye(3),
    },
    hg.Robot: {"description": ROBOT.description, "model": SCENE.model},
    hg.RobotDescription.load: {"robot": "bhand"},
    hg.Scene: {"robot": "bhand"},
    hg.SimulatedHand: {"scene": SCENE},
    hg.Stack: {"priorities": ((hg.ForceTask(),),)},
    hg.Start: {},
    hg.StepLimit: {},
    hg.Study: {"trial": hg.Trial(SCENE, STACK)},
    hg.Touch: {"q_target": np.zeros(2), "felt": hg.Grasp(**GRASP)},
    hg.Trial: {"scene": SCENE, "stack": STACK},
    hg.VelocityLimit: {"velocity": np.ones(2), "dt": 0.1},
    hg.form_of: {"name": "hierarchy"},
    hg.sense: {"wrench": np.array([1.0, 0, 0, 0, 0, 0]), "tip": 0.01},
    hg.solve_ik: {
        "configuration": CONFIGURATION,
        "priorities": [POSTURE],
        "dt": 0.01,
    },
    hg.stack_of: {"letters": "fm"},
    Fault: {"kind": "stall", "finger": 0, "begin": 0.0},
}
CALLS[hg.Body] = {"file": "", "scale": 1.0}  # the fixture `body` writes the file
ANSWERS = {  # what the package hands out, and what is abstract
    *(
        "ContactSpaceTask",
        "Driver",
        "Felt",
        "ForceLaw",
        "Form",
        "GRIP_LAWS",
        "Judged",
        "Lift",
        "Picked",
        "Press",
        "Squeeze",
        "LevelReport",
        "Limit",
        "Miss",
        "Priority",
        "Probe",
        "Record",
    ),
    *("Solution", "Step", "Task", "ik_levels", "load_history", "save_history", "solvers"),
    "check_driver",  # needs one to try: tests/touch/test_driver.py
    "lift",  # needs a hand that holds: tests/experiments/test_pick.py
}
NO_NUMBER = ("0.05", True, 1j, [0.05], object(), b"1", {})
WRONG = (*NO_NUMBER, "nonsense", None, -1, 3.5, np.nan, (), [[]], np.array(["a"]), np.array([1, 2]))


@pytest.fixture
def call(tmp_path):
    """Calls with one argument replaced."""
    mesh = tmp_path / "box.xml"
    mesh.write_text(
        '<mujoco><worldbody><body><geom type="box" size=".03 .03 .03"/></body></worldbody></mujoco>'
    )

    def made(it, **changed):
        return it(**({"file": mesh} if it is hg.Body else CALLS[it]) | changed)

    return made


def name_of(it):
    return it.__qualname__


def parameters(it):
    hints = get_type_hints(it.__init__ if isinstance(it, type) else it)
    names = [n for n in inspect.signature(it).parameters if n in hints]
    return {n: hints[n] for n in names}


def kinds(hint):
    return set(get_args(hint)) if get_origin(hint) in (Union, UnionType) else {hint}


def part_of(hint):
    """The class of hqp_grasp that this is to be, if it is to be one."""
    found = [kind for kind in kinds(hint) if kind is not type(None)]
    one = len(found) == 1 and isinstance(found[0], type)
    return found[0] if one and found[0].__module__.startswith("hqp_grasp.") else None


def is_protocol(kind):
    return Protocol in kind.__bases__


EVERY = [(it, name) for it in CALLS for name in parameters(it)]
NUMBERS = [(it, n) for it, n in EVERY if kinds(parameters(it)[n]) <= {int, float, type(None)}]
PARTS = [(it, n) for it, n in EVERY if part_of(parameters(it)[n])]
FLAGS = [(it, n) for it, n in EVERY if parameters(it)[n] is bool]


def each(pairs):
    return pytest.mark.parametrize(
        ("it", "name"), pairs, ids=lambda v: getattr(v, "__qualname__", v)
    )


def test_all_that_is_exported_is_tried_here():
    exported = {n for n in hg.__all__ if not n.endswith("Error")} - ANSWERS
    assert exported == {name_of(it).split(".")[0] for it in CALLS} - {"Fault"}


@each(EVERY)
def test_a_wrong_argument_is_taken_or_refused_in_words(call, it, name):
    for wrong in WRONG:
        with suppress(hg.HqpGraspError):
            call(it, **{name: wrong})


@each(NUMBERS)
def test_what_is_no_number_is_refused_by_name(call, it, name):
    for wrong in NO_NUMBER:
        with pytest.raises(hg.InputError, match=rf"{name}.* must be a (whole )?number.*; got "):
            call(it, **{name: wrong})


@each(NUMBERS)
def test_numbers_of_numpy_become_pythons(call, it, name):
    kind = int if int in kinds(parameters(it)[name]) else float
    for given in (np.int64(3), np.uint8(3)) if kind is int else (np.float32(0.5), np.array(0.5)):
        made = call(it, **{name: given})
        if dataclasses.is_dataclass(made):
            assert type(getattr(made, name, kind())) is kind


@each(PARTS)
def test_what_is_not_of_the_class_asked_for_is_refused_by_name(call, it, name):
    kind = part_of(parameters(it)[name])
    itself = () if is_protocol(kind) else (kind,)
    for wrong in ("nonsense", 1.0, object(), (), *itself):
        with pytest.raises(hg.InputError, match=rf"{name}.* must (be|have) "):
            call(it, **{name: wrong})


@each(FLAGS)
def test_a_flag_is_true_or_false(call, it, name):
    for wrong in ("no", 1, None):
        with pytest.raises(hg.InputError, match=rf"{name} must be True or False"):
            call(it, **{name: wrong})


def test_the_helpers_say_what_would_be_right():
    assert number("n", np.float32(0.5)) == 0.5 and whole("n", np.int64(2), 0) == 2
    for wrong in (lambda: number("n", True), lambda: number("n", "1"), lambda: number("n", None)):
        with pytest.raises(hg.InputError, match="n must be a number; got "):
            wrong()
    for wrong in (True, "2", 2.0, np.bool_(True), None):
        with pytest.raises(
            hg.InputError, match=re.escape(f"n must be a whole number; got {wrong!r}")
        ):
            whole("n", wrong, 0)
    with pytest.raises(hg.InputError, match="n must be at least 1; got 0"):
        whole("n", 0, 1)
    with pytest.raises(hg.InputError, match="n must be finite and above 0; got 0"):
        positive("n", 0)
    with pytest.raises(hg.InputError, match="n must be finite and at least 0; got -1"):
        not_negative("n", -1)
    with pytest.raises(hg.InputError, match="n must be True or False; got 'no'"):
        flag("n", "no")
    with pytest.raises(hg.InputError, match=r"unknown n .*; choose one of: a, b"):
        one_of("n", np.array(["a", "b"]), ("a", "b"))


def test_a_scene_of_numpys_numbers_is_saved_and_read(tmp_path):
    prism = hg.Prism.regular(np.int64(6), np.float32(0.03), np.float32(0.125))
    for thing in (prism, hg.Cylinder(np.float32(0.0625), np.float64(0.125))):
        scene = hg.Scene("bhand", thing, position=np.array([0.5, 0.0, 0.25], dtype=np.float32))
        scene.save(tmp_path / "scene.json")
        assert hg.Scene.load(tmp_path / "scene.json") == scene
        assert json.loads((tmp_path / "scene.json").read_text())["object"]["height"] == 0.125


# What is taken where nothing is given; what else has no default, or one that says nothing.
DEFAULTS = {
    hg.Body: {"scale": 1.0},
    hg.ClearanceLimit: {"within": 0.04},
    hg.Contact: {"name": "", "point": None, "flexion": (), "tip_radius": 0.0, "noise": 0.0},
    hg.Controller: {"form": "hierarchy", "budget": None, "landing": True},
    hg.Cylinder: {"height": 0.12},
    hg.DriverLimits: {"grip": 0.0},
    hg.ForceTask: {"gain": 1.0, "weight": 1.0, "radius": 0.05},
    hg.GeometricProbe: {"links": "block"},
    hg.Grip: {"force": 5.0, "friction": 0.5, "most": 15.0, "hqp": hg.HQP("daqp")},
    hg.HQP: {"solver": "proxqp", "rank_tolerance": None, "budget": 60_000_000},
    hg.HierarchyForm: {"size": 0.05},
    hg.Hold: {"patience": 3},
    hg.MinkLimit: {"model": None, "dt": 1.0},
    hg.MomentTask: {"gain": 1.0, "weight": 1.0, "reference": "centroid"},
    hg.Noise: {"normal": 0.0, "position": 0.0},
    hg.PhysicalProbe: {"force": 1.0, "table": None},
    hg.Physics: {"contact": "medium", "support": "fixed", "mass": 0.1, "friction": 0.6}
    | {"timestep": 0.002},
    hg.Pick: {"force": 5.0, "friction": 0.5, "height": 0.1},
    hg.PostureTask: {"gain": 1.0, "weight": 1.0, "target": None},
    hg.Prism: {"height": 0.12},
    hg.Projection: {"damping": 0.0, "rank_tolerance": None},
    hg.Scene: {"robot": "wam_bhand", "position": None, "base": (0, 0, 0, 1, 0, 0, 0)},
    hg.SimulatedHand: {"links": "block", "force_limit": 15.0, "watchdog": 1.0, "grip_limit": 20.0},
    hg.Solution: {"failed": (), "certified": False, "rank_tolerance": None},
    hg.Stack: {"limits": (), "hold_contacts": True},
    hg.StepLimit: {"joint": 0.35, "contact": 0.03},
    hg.Study: {"trials": 40, "seed": 0, "jobs": 1, "strict": False, "cluster": None},
    hg.Trial: {"probes": 60, "form": "hierarchy", "landing": True, "links": "block"}
    | {"probe": "geometric", "preset": None, "noise": None},
    hg.solve_ik: {"solver": "active-set", "damping": 0.0, "safety_break": False},
}


@pytest.mark.parametrize("what", DEFAULTS, ids=lambda what: what.__name__)
def test_what_is_not_given_is_what_pages_and_signatures_say(what):
    given = {p.name: p.default for p in inspect.signature(what).parameters.values()}
    assert {name: given[name] for name in DEFAULTS[what]} == DEFAULTS[what]


def test_a_world_is_perfect_unless_told_otherwise():
    values = {f.name: f.default for f in dataclasses.fields(hg.Imperfections)}
    assert values.pop("faults") == () and set(values.values()) == {0.0}
