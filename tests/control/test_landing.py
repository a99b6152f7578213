"""Landing: the fingertips arrive where the linear prediction put them."""

from dataclasses import replace

import numpy as np
import pytest

from hqp_grasp.control.controller import Controller
from hqp_grasp.control.episode import Episode
from hqp_grasp.control.landing import land
from hqp_grasp.control.limits import ConfigurationLimit, StepLimit
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Touch
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.tasks import stack_of
from hqp_grasp.world.scene import Scene

ARRIVED = 3e-4  # [m], three damped Newton steps from up to 8 cm off
ROUNDING = 1e-9  # [–] of a limit


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def robot(scene):
    return scene.articulated


@pytest.fixture(scope="module")
def steps(scene, robot):
    """Grasps felt, each with the step that the laws ask for."""
    stack = stack_of("fmk")
    form, limited = Controller(robot, stack).form, Controller(robot, stack).stack
    records = [Trial(scene, stack, probes=2).run((616, i)) for i in range(3)]
    return [
        (g, form.plan(limited, Episode.of([Touch(g.q, g)])).x)
        for record in records
        for g in record.grasps
    ]


def missed(robot, grasp, x, landed):
    """How far the tips are, at grasp.q + landed, from where J x says [m]."""
    goal = robot.centers(grasp.q).ravel() + grasp.jacobian @ x
    return np.abs(robot.centers(grasp.q + landed).ravel() - goal).max()


def test_tips_that_would_be_centimetres_off_arrive_to_a_fraction_of_a_millimetre(robot, steps):
    stack = stack_of("fmk").within(StepLimit(2.0, 0.5), ConfigurationLimit(robot))
    assert max(missed(robot, grasp, x, x) for grasp, x in steps) > 0.03
    for grasp, x in steps:
        assert missed(robot, grasp, x, land(robot, stack, grasp, x)) < ARRIVED


def test_limits_come_before_landing(robot, steps):
    stack = stack_of("fmk").within(StepLimit(), ConfigurationLimit(robot))
    for grasp, x in steps:
        landed = land(robot, stack, grasp, x)
        assert missed(robot, grasp, x, landed) <= missed(robot, grasp, x, x) + ROUNDING
        for level in stack.limit_levels(grasp):
            assert np.abs(level.residual(landed)).max() <= ROUNDING


def test_a_step_already_beyond_its_limits_is_neither_forced_back_nor_taken_farther(robot, steps):
    stack = stack_of("fmk").within(StepLimit(0.02, 10.0))  # joints only: [rad], [m]
    beyond = 0
    for grasp, x in [(g, sign * x) for g, x in steps for sign in (1.0, -1.0)]:
        landed = land(robot, stack, grasp, x)
        assert missed(robot, grasp, x, landed) < 0.1 * missed(robot, grasp, x, x)
        for level in stack.limit_levels(grasp):
            before, after = (np.abs(level.residual(y)) for y in (x, landed))
            assert (after <= before + ROUNDING).all()
            beyond += np.count_nonzero(before)
    assert beyond


def test_a_step_that_lands_by_itself_is_left_as_it_is(robot, steps):
    stack = stack_of("fmk").within(StepLimit())
    for grasp, x in steps:
        tiny = 1e-4 * x
        np.testing.assert_array_equal(land(robot, stack, grasp, tiny), tiny)


def test_a_correction_that_is_not_certified_is_not_made(robot, steps, monkeypatch):
    stack = stack_of("fmk").within(StepLimit(2.0, 0.5), ConfigurationLimit(robot))
    solve, certified = HQP.solve, []

    def doubtful_from_the_second_on(self, levels, warm=None):
        answer = solve(self, levels, warm)
        certified.append(answer)
        return answer if len(certified) == 1 else replace(answer, certified=False)

    monkeypatch.setattr(HQP, "solve", doubtful_from_the_second_on)
    for grasp, x in steps:
        certified.clear()
        landed = land(robot, stack, grasp, x)
        assert len(certified) == 2
        np.testing.assert_array_equal(landed, x + certified[0].x)
