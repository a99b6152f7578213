"""What has been felt predicts what has not: memories of known shapes, and trials that need one."""

import dataclasses

import numpy as np
import pytest
from hqp_grasp.scenarios import irregular

from hqp_grasp.control.memory import SurfaceMemory
from hqp_grasp.errors import InputError
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Grasp, Miss, Missed, Touch
from hqp_grasp.tasks import stack_of

RADIUS = 0.04  # [m]
TIP = 0.008  # [m]
UP = np.array([0.0, 0.0, 1.0])


def touch(angles, at, probe_height=0.0):
    """A touch of a surface whose normal at an angle is level, its points given by `at`."""
    contacts = []
    for t in angles:
        n = np.array([np.cos(t), np.sin(t), 0.0])
        contacts.append(Contact(at(t) + probe_height * UP, n, tip_radius=TIP))
    k = len(contacts)
    return Touch(np.zeros(3 * k), Grasp(np.zeros(3 * k), contacts, np.eye(3 * k)))


def on_circle(t):
    return RADIUS * np.array([np.cos(t), np.sin(t), 0.0])


def test_points_of_a_circle_predict_the_circle():
    history = [touch([0.1, 2.0, 4.4], on_circle), touch([0.9, 2.7, 5.1], on_circle, 0.01)]
    memory = SurfaceMemory.of(history)
    np.testing.assert_allclose(memory.radii, RADIUS, rtol=0.01)
    axis = memory.axis(history[-1].felt)
    np.testing.assert_allclose(np.abs(axis), UP, atol=1e-6)
    outline = memory.outline(axis, TIP)
    s = outline.length * np.linspace(0.0, 1.0, 50, endpoint=False)
    angle, x = outline.at(s)
    n = np.column_stack([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(x, RADIUS * n, atol=1e-3)
    assert outline.length == pytest.approx(2.0 * np.pi * (RADIUS + TIP), rel=0.01)


def test_a_point_that_a_later_touch_contradicts_is_forgotten():
    """The object has moved by 2 mm: what was felt before lies outside what is felt now."""
    before = touch([0.0, 2.1, 4.2], on_circle)
    after = touch([0.0, 2.1, 4.2], lambda t: on_circle(t) + np.array([0.002, 0, 0]))
    memory = SurfaceMemory.of([before, after])
    newest = len(memory.probes) - 3
    assert set(memory.probes[newest:]) == {1}
    np.testing.assert_allclose(memory.positions[-3:], after.felt.positions)
    assert len(memory.probes) < 6  # some of the old ones are gone


def test_misses_leave_no_trace_and_a_memory_of_nothing_is_refused():
    first = touch([0.0, 2.1, 4.2], on_circle)
    missed = Touch(np.zeros(9), Missed(Miss.NO_TOUCH, "finger_1"))
    np.testing.assert_array_equal(
        SurfaceMemory.of([first, missed]).positions, SurfaceMemory.of([first]).positions
    )
    with pytest.raises(InputError, match="nothing has been felt yet"):
        SurfaceMemory.of([missed])


def test_on_an_irregular_prism_only_the_memory_finds_balance():
    trial = Trial(irregular.scene, stack_of("fmk"), probes=30, form="memory")
    seeds = [(90210, i) for i in range(5)]
    with_memory = [trial.run(seed).verdict for seed in seeds]
    without = [dataclasses.replace(trial, form="hierarchy").run(seed).verdict for seed in seeds]
    assert with_memory.count("good") >= 4
    assert without.count("good") <= 1
