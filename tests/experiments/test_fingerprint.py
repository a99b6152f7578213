"""Two configurations are told apart by all that decides, and by nothing else."""

import copy
import copyreg
import dataclasses
import functools
import importlib
import json
import sys
from enum import Enum
from pathlib import Path

import mink
import numpy as np
import pytest
import tiny_hand
from own_law import HeightTask

from hqp_grasp.control.limits import ConfigurationLimit, StepLimit, VelocityLimit
from hqp_grasp.experiments import fingerprint as module
from hqp_grasp.experiments.fingerprint import Fingerprint, differences
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.tasks import ForceTask, Limit, Priority, stack_of
from hqp_grasp.world.scene import Cylinder, Scene

LAW = """
from dataclasses import dataclass
from hqp_grasp.tasks import ForceTask
from {helper} import SCALE

GAIN = 1.0

@dataclass(frozen=True)
class OwnTask(ForceTask):
    def error(self, grasp):
        return SCALE * GAIN * super().error(grasp)
"""


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture
def trial(scene):
    return Trial(scene, stack_of("fm"), probes=3)


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A law in a file of its own, which imports another: returns a function that loads it."""
    monkeypatch.syspath_prepend(tmp_path)
    helper, law = f"helper_{tmp_path.name}", f"law_{tmp_path.name}"

    def load(law_text=LAW, scale="1.0"):
        (tmp_path / f"{helper}.py").write_text(f"SCALE = {scale}\n")
        (tmp_path / f"{law}.py").write_text(law_text.format(helper=helper))
        for name in (helper, law):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        return importlib.import_module(law).OwnTask

    yield load
    for name in (helper, law):
        sys.modules.pop(name, None)


def told_apart(one, other):
    """Where the fingerprints of two values differ."""
    one, other = Fingerprint(one), Fingerprint(other)
    assert one.unknown == other.unknown == []
    return list(differences(*(json.loads(json.dumps(v.parts)) for v in (one, other))))


# ---------------------------------------------------------------- values


def test_the_same_configuration_built_twice_has_one_fingerprint(trial):
    again = Trial(Scene(), stack_of("fm"), probes=3)
    again.run(0)  # what a scene and a trial remember of their use does not matter
    assert told_apart(trial, again) == []


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"probes": 4}, "trial.probes is 3 there, 4 here"),
        ({"form": "paper"}, "trial.form is 'hierarchy' there, 'paper' here"),
        ({"stack": stack_of("fmk")}, "trial.stack.priorities differs"),
        ({"stack": ForceTask(gain=0.9) >> stack_of("m")}, "trial.stack.priorities[0][0].gain is"),
        ({"scene": Scene(object=Cylinder(0.04))}, "trial.scene.object.radius is 0.05 there, 0.04"),
    ],
)
def test_what_differs_is_named_with_both_values(trial, change, where):
    found = told_apart(trial, dataclasses.replace(trial, **change))
    assert any(difference.startswith(where) for difference in found), found


def test_every_number_of_an_array_counts(scene, trial):
    velocity = np.linspace(1.0, 2.0, scene.articulated.n)
    other = velocity.copy()
    other[5] = np.nextafter(other[5], 9.0)
    limits = [VelocityLimit(velocity, 1.0), VelocityLimit(other, 1.0)]
    one, two = (dataclasses.replace(trial, stack=trial.stack.within(limit)) for limit in limits)
    assert told_apart(one, two) == ["trial.stack.limits[0].velocity differs"]
    assert told_apart(one, one) == []


def test_geom_pairs_of_minks_collision_limit_count(scene, trial):
    model = scene.model
    geoms = [["f1_tip"], ["f2_tip"], ["f3_tip"]]
    made = [
        trial.stack.within(mink.CollisionAvoidanceLimit(model, [pair]))
        for pair in ((geoms[0], geoms[1]), (geoms[0], geoms[2]), (geoms[0], geoms[1]))
    ]
    one, other, same = (dataclasses.replace(trial, stack=stack) for stack in made)
    assert told_apart(one, same) == []
    assert told_apart(one, other)[0].startswith("trial.stack.limits[0].limit.geom_id_pairs[0]")


def test_a_robot_counts_by_its_compiled_model_and_not_by_where_it_stands(tmp_path):
    here, there = tmp_path / "here" / "tiny", tmp_path / "there" / "tiny"
    for folder in (here, there):
        folder.mkdir(parents=True)
        tiny_hand.write(folder)
    assert told_apart(Scene(here), Scene(there)) == []
    tiny_hand.write(there, tiny_hand.change(tiny_hand.XML, 'size="0.01"', 'size="0.011"'))
    assert told_apart(Scene(here), Scene(there)) == ["trial.robot.model differs"]
    tiny_hand.write(
        there, toml=tiny_hand.change(tiny_hand.TOML, "proximal = 2.0", "proximal = 2.5")
    )
    assert told_apart(Scene(here), Scene(there)) == [
        "trial.robot.velocity.proximal is 2.0 there, 2.5 here"
    ]


@pytest.mark.parametrize("name", ["geom_size", "jnt_range", "qpos0", "eq_data", "body_mass"])
def test_any_number_of_a_model_counts(scene, name):
    one, other = copy.copy(scene.model), copy.copy(scene.model)
    assert told_apart(one, other) == []
    getattr(other, name).flat[-1] += 1e-9
    assert told_apart(one, other) == ["trial differs"]


@pytest.mark.parametrize("name", ["timestep", "ccd_tolerance", "gravity"])
def test_any_option_of_a_model_counts(scene, name):
    one, other = copy.copy(scene.model), copy.copy(scene.model)
    setattr(other.opt, name, getattr(one.opt, name) + 1e-9)
    assert told_apart(one, other) == ["trial differs"]


def test_attributes_that_are_no_fields_count_too():
    task = HeightTask()
    other = HeightTask()
    object.__setattr__(other, "floor", 0.1)
    assert told_apart(task, other) == ["trial.floor is None there, 0.1 here"]


def test_what_python_keeps_elsewhere_than_in_attributes_counts():
    one, other = functools.partial(max, 1), functools.partial(max, 2)
    assert told_apart(one, other) and told_apart(one, one) == []


def test_values_json_has_no_word_for_can_be_compared_after_they_were_stored():
    strange = {"a": np.inf, "b": np.int64(3), "c": {2, 1}, "d": Priority.CAP, "e": -0.5}
    assert told_apart(strange, dict(strange)) == []
    assert told_apart(strange, {**strange, "a": -np.inf}) == ["trial.a is 'inf' there, '-inf' here"]
    endless = []
    endless.append(endless)
    assert told_apart(endless, endless) == []


# ---------------------------------------------------------------- sources


def test_a_constant_edited_in_a_law_of_ones_own_counts(own):
    before = Fingerprint(own()()).parts
    same = Fingerprint(own()()).parts
    edited = Fingerprint(own(LAW.replace("GAIN = 1.0", "GAIN = 2.0"))()).parts
    imported = Fingerprint(own(scale="2.0")()).parts
    assert before == same
    assert [d.partition("_")[0] for d in differences(before, edited)] == ["source.law"]
    assert [d.partition("_")[0] for d in differences(before, imported)] == ["source.helper"]


def test_a_limit_of_ones_own_counts_by_its_source(trial):
    stack = trial.stack.within(OwnLimit())
    sources = Fingerprint(dataclasses.replace(trial, stack=stack)).parts["source"]
    assert set(sources) >= {OwnLimit.__module__, "own_law", "tiny_hand"}


class OwnLimit(StepLimit):
    """A limit that a user wrote."""


def test_an_edited_checkout_of_hqp_grasp_counts(monkeypatch, tmp_path, trial):
    copy = tmp_path / "hqp_grasp"
    copy.mkdir()
    (copy / "law.py").write_text("GAIN = 1.0\n")
    monkeypatch.setattr(module, "PACKAGE", copy)
    before = Fingerprint(trial).parts
    (copy / "law.py").write_text("GAIN = 2.0\n")
    assert list(differences(before, Fingerprint(trial).parts)) == ["hqp_grasp differs"]


def test_hqp_grasp_counts_by_every_file_of_its_own(monkeypatch, trial):
    hashed = []
    digest = module._digest
    monkeypatch.setattr(module, "_digest", lambda *paths: hashed.extend(paths) or digest(*paths))
    Fingerprint(trial)
    names = {path.relative_to(module.PACKAGE).as_posix() for path in hashed}
    assert {
        "__init__.py",
        "hierarchy/active_set.py",
        "tasks/force.py",
        "control/limits.py",
    } <= names


# ---------------------------------------------------------------- what cannot be had


def test_a_law_without_a_source_is_named(trial):
    names = {"__name__": "own_law", "ForceTask": ForceTask}
    exec("class MadeTask(ForceTask):\n    pass", names)
    lone = dataclasses.make_dataclass("LoneTask", [], bases=(ForceTask,), frozen=True)
    for task in (names["MadeTask"](), lone()):
        stack = dataclasses.replace(trial, stack=task >> stack_of("m"))
        (reason,) = Fingerprint(stack).unknown
        assert type(task).__name__ in reason and "no source that can be read" in reason
        assert "trial.stack.priorities[0][0]" in reason


def test_a_class_made_inside_a_function_and_a_lambda_are_named(trial):
    class InnerLimit(Limit):
        priority = Priority.CAP

        def __init__(self, rule):
            self.rule = rule

        def level(self, grasp):
            return self.rule(grasp)

    stack = trial.stack.within(InnerLimit(lambda grasp: None))
    unknown = Fingerprint(dataclasses.replace(trial, stack=stack)).unknown
    assert len(unknown) == 2
    assert "InnerLimit (trial.stack.limits[0])" in unknown[0]
    assert "<lambda> (trial.stack.limits[0].rule)" in unknown[1]


def test_an_object_that_cannot_be_read_is_named(trial):
    unknown = Fingerprint({"lines": (line for line in "abc")}).unknown
    assert "trial['lines']: a generator cannot be read" in unknown


def test_limits_of_this_package_are_known(scene, trial):
    limits = StepLimit(), ConfigurationLimit(scene.articulated), VelocityLimit([1.0] * 11, 1.0)
    stack = trial.stack.within(*limits, mink.ConfigurationLimit(scene.model))
    assert Fingerprint(dataclasses.replace(trial, stack=stack)).unknown == []


@pytest.mark.parametrize(
    ("there", "here", "said"),
    [
        ({"a": 1, "b": {"c": [1, 2]}}, {"a": 1, "b": {"c": [1, 2]}}, []),
        ({"a": 1}, {"a": 2}, ["a is 1 there, 2 here"]),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, ["a.b[1] is 2 there, 3 here"]),
        ({"a": [1]}, {"a": [1, 2]}, ["a is [1] there, [1, 2] here"]),
        ({"a": 1}, {"b": 1}, ["a is 1 there, None here", "b is None there, 1 here"]),
        ({"a": "x" * 38}, {"a": "y"}, [f"a is '{'x' * 38}' there, 'y' here"]),
        ({"a": "x" * 39}, {"a": "y"}, ["a differs"]),
        ({"a": "sha256:1"}, {"a": "z"}, ["a differs"]),
        ({"a": [{"b": 1}]}, {"a": [{"b": "1"}]}, ["a[0].b is 1 there, '1' here"]),
    ],
)
def test_differences_are_told_by_their_place_and_both_values_where_they_are_short(
    there, here, said
):
    assert list(differences(there, here)) == said


class Kind(Enum):
    ONE = 1


@pytest.mark.parametrize(
    ("value", "described"),
    [
        (None, None),
        (True, True),
        ("text", "text"),
        (Kind.ONE, "Kind.ONE"),
        (np.int64(3), 3),
        (np.bool_(True), 1),
        (np.float64(0.5), 0.5),
        (np.inf, "inf"),
        (Path("a") / "b", "a/b"),
        ({1: (2, 3)}, {"1": [2, 3]}),
        (frozenset({"b", "a"}), ["a", "b"]),
    ],
)
def test_plain_values_are_described_as_json_can_hold_them(value, described):
    assert Fingerprint(value).parts["trial"] == described


def test_arrays_count_by_their_type_shape_and_numbers_and_what_holds_itself_ends():
    one = Fingerprint(np.zeros((2, 3))).parts["trial"]
    assert one.startswith("float64[2, 3] sha256:")
    for other in (np.zeros((3, 2)), np.zeros((2, 3), np.float32), np.eye(3)[:2]):
        assert Fingerprint(other).parts["trial"] != one
    endless = [1]
    endless.append(endless)
    assert Fingerprint(endless).parts["trial"] == [1, "itself"]
    twice = [0]
    assert Fingerprint([twice, twice]).parts["trial"] == [[0], [0]]  # beside is not within


class Listed:
    """Made anew from its attributes and from a list of items."""

    def __init__(self, *items):
        self.size, self._items = len(items), items

    def __reduce_ex__(self, protocol):
        return copyreg.__newobj__, (Listed,), {"size": self.size}, iter(self._items), None


def test_what_is_made_of_items_beside_its_attributes_counts_by_both():
    found = [Fingerprint(Listed(*items)).parts["trial"] for items in ((1, 2), (1, 2), (1, 3))]
    assert found[0] == found[1] != found[2]
