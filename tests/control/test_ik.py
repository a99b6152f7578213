"""mink's tasks, limits and constraints in strict priority: mink's own answers, and beyond them."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import mink
import mujoco
import numpy as np
import pytest
from mink.tasks import BaseTask, Objective

from hqp_grasp.control.ik import ik_levels, solve_ik
from hqp_grasp.errors import InputError, SolverError
from hqp_grasp.hierarchy.hqp import HQP

ROOT = Path(__file__).parents[2]
SEEDS = range(20)
AGREE = 1e-6  # [rad, m] mink damps with 1e-12, and its solvers stop early
EXACT = 1e-11  # [rad] on steps of order 0.01, through couplings and projections


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


strictness = load(ROOT / "benchmarks" / "strictness.py")
DT = strictness.DT

FLOATING = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base">
      <freejoint name="base"/>
      <geom type="box" size=".1 .1 .05" mass="1"/>
      <body name="shoulder" pos=".1 0 0">
        <joint name="shoulder" type="ball" range="0 .8"/>
        <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".2"/>
        <body name="elbow" pos=".3 0 0">
          <joint name="elbow" axis="0 1 0" range="-2 2"/>
          <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".2"/>
          <site name="tip" pos=".3 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.fixture
def world(request: pytest.FixtureRequest) -> Any:
    return strictness.World(np.random.default_rng(getattr(request, "param", 0)))


def gap(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max())


def weighted(tasks: list[mink.Task]) -> list[mink.Task]:
    for task, weight in zip(tasks, (1.0, 0.3, 0.1), strict=True):
        task.cost = weight * task.cost
    return tasks


def floating() -> tuple[mink.Configuration, mink.FrameTask]:
    configuration = mink.Configuration(mujoco.MjModel.from_xml_string(FLOATING))
    task = mink.FrameTask("tip", "site", position_cost=1.0, orientation_cost=0.5)
    task.set_target(
        mink.SE3.from_rotation_and_translation(
            mink.SO3.from_x_radians(0.3), np.array([0.5, 0.2, 0.1])
        )
    )
    return configuration, task


class Pull(BaseTask):
    """A user's own objective ½ xᵀ H x + cᵀ x."""

    def __init__(self, H: np.ndarray, c: np.ndarray) -> None:
        self.H, self.c = H, c

    def compute_qp_objective(self, configuration: mink.Configuration) -> Objective:
        return Objective(self.H, self.c)


# ---------------------------------------------------------------- one priority is mink's problem


@pytest.mark.parametrize("world", SEEDS, indirect=True)
def test_one_priority_gives_the_answer_of_mink(world):
    configuration = world.configuration(world.inside())
    tasks = weighted(world.tasks(configuration))
    for given in (
        {},
        {"limits": []},
        {"limits": world.limits, "constraints": [world.couplings]},
    ):
        theirs = DT * mink.solve_ik(configuration, tasks, DT, "daqp", **given)
        assert gap(DT * solve_ik(configuration, [tasks], DT, **given), theirs) < AGREE


@pytest.mark.parametrize("world", SEEDS, indirect=True)
def test_damping_of_a_task_and_of_the_call_mean_what_they_mean_in_mink(world):
    configuration = world.configuration(world.inside())
    tasks = weighted(world.tasks(configuration))[:2]
    tasks[0].lm_damping = 0.3
    given = {"limits": world.limits, "constraints": [world.couplings]}
    for damping in (0.0, 1e-3):
        theirs = DT * mink.solve_ik(configuration, tasks, DT, "daqp", damping, **given)
        ours = DT * solve_ik(configuration, [tasks], DT, "daqp", damping, **given)
        assert gap(ours, theirs) < AGREE


@pytest.mark.parametrize("world", SEEDS[:5], indirect=True)
def test_dense_hessians_mean_what_they_mean_in_mink(world):
    configuration = world.configuration(world.inside())
    energy = mink.KineticEnergyRegularizationTask(cost=1e-3)
    energy.set_dt(DT)
    root = world.rng.normal(size=(4, configuration.nv))  # singular: leaves eleven directions free
    pull = Pull(root.T @ root, root.T @ world.rng.normal(size=4))
    tasks = [*world.tasks(configuration)[:1], energy, pull]
    theirs = DT * mink.solve_ik(configuration, tasks, DT, "daqp")
    assert gap(DT * solve_ik(configuration, [tasks], DT), theirs) < AGREE


def test_where_a_task_leaves_freedom_the_shortest_motion_is_returned():
    configuration, task = floating()
    W, e, _ = task.compute_qp_residual(configuration)
    x = solve_ik(configuration, [task], 1.0, limits=[])
    assert gap(x, np.linalg.pinv(W) @ e) < EXACT
    theirs = mink.solve_ik(configuration, [task], 1.0, "daqp", damping=1e-9, limits=[])
    assert gap(x, theirs) < AGREE


def test_floating_bases_and_ball_joints_work_as_in_mink():
    configuration, task = floating()
    model = configuration.model
    assert configuration.nq != configuration.nv
    limits = [
        mink.ConfigurationLimit(model),
        mink.VelocityLimit(model, {"shoulder": [1.0, 1.0, 1.0], "elbow": 0.5}),
        mink.FreeJointVelocityLimit(model, max_linear_velocity=0.1, max_angular_velocity=0.2),
    ]
    tasks = [task, mink.DampingTask(model, cost=1e-2)]
    for _ in range(30):
        v = solve_ik(configuration, [tasks], 0.05, limits=limits)
        theirs = mink.solve_ik(configuration, tasks, 0.05, "daqp", limits=limits)
        assert gap(0.05 * v, 0.05 * theirs) < AGREE
        configuration.integrate_inplace(v, 0.05)
    configuration.check_limits(tol=1e-3)  # a ball joint's limit is linear; mink's is as much


def test_a_task_alone_is_a_priority_and_one_in_a_list_the_same(world):
    configuration = world.configuration(world.inside())
    first, second, _ = world.tasks(configuration)
    assert (
        solve_ik(configuration, [first, second], DT)
        == solve_ik(configuration, [[first], (second,)], DT)
    ).all()


# ---------------------------------------------------------------- strictness


def test_lower_tasks_never_worsen_the_first(world):
    seen = strictness.strictness(world, 60, HQP())
    assert seen.worsened == 0
    assert seen.uncertified == 0
    assert seen.limit_active > 50 and 20 < seen.unmet < 60  # the draw is not an easy one
    assert seen.worsened_by_weights > 20


@pytest.mark.parametrize("world", SEEDS[:5], indirect=True)
def test_a_damped_task_is_not_disturbed_and_leaves_the_rest_free(world):
    configuration = world.configuration(world.inside())
    place, turn, posture = world.tasks(configuration)
    place.lm_damping = 0.1
    given = {"limits": world.limits, "constraints": [world.couplings]}
    W, _, mu = place.compute_qp_residual(configuration)
    assert mu > 0.0
    alone = DT * solve_ik(configuration, [place], DT, **given)
    above = DT * solve_ik(configuration, [place, turn, posture], DT, **given)
    assert gap(W @ above, W @ alone) < EXACT
    assert gap(above, alone) > 1e-3


@pytest.mark.parametrize("world", SEEDS[:5], indirect=True)
def test_costs_decide_nothing_between_priorities(world):
    configuration = world.configuration(world.inside())
    place, turn, posture = world.tasks(configuration)
    before = DT * solve_ik(configuration, [place, turn, posture], DT, limits=world.limits)
    posture.cost = 1e3 * posture.cost
    after = DT * solve_ik(configuration, [place, turn, posture], DT, limits=world.limits)
    assert gap(before, after) < EXACT


@pytest.mark.parametrize("world", SEEDS[:10], indirect=True)
def test_couplings_hold_exactly_above_everything_asked(world):
    configuration = world.configuration(world.inside())
    J = world.couplings.compute_jacobian(configuration)
    assert J.shape == (4, 15)
    given = {"limits": world.limits, "constraints": [world.couplings]}
    x = DT * solve_ik(configuration, world.tasks(configuration), DT, **given)
    assert np.abs(x).max() > 1e-3
    assert np.abs(J @ x).max() < EXACT


# ---------------------------------------------------------------- where mink raises


def test_a_start_outside_a_range_comes_back_as_fast_as_the_caps_allow(world):
    seen = strictness.start_outside(world, 30, HQP())
    assert seen.answered == seen.within_caps == seen.reported == seen.right == 30
    assert seen.certified == 30
    assert min(seen.mink_raises.values()) == 30


def test_a_hard_target_out_of_reach_is_approached_within_limits(world):
    seen = strictness.hard_target(world, 30, HQP())
    assert seen.answered == seen.within_caps == seen.reported == seen.right == 30
    assert seen.certified == 30
    assert min(seen.mink_raises.values()) == 30


@pytest.mark.parametrize("world", SEEDS[:3], indirect=True)
def test_on_the_way_back_into_range_couplings_hold_and_tasks_are_served(world):
    configuration = world.configuration(world.outside())
    assert world.violation(configuration, np.zeros(15)).max() > 0.09
    posture = world.tasks(configuration)[2]
    off = np.abs(posture.compute_error(configuration)).max()
    for _ in range(100):
        v = solve_ik(
            configuration, [posture], DT, limits=world.limits, constraints=[world.couplings]
        )
        configuration.integrate_inplace(v, DT)
        assert np.abs(world.couplings.compute_error(configuration)).max() < 1e-9
    assert world.violation(configuration, np.zeros(15)).max() < 1e-9
    assert np.abs(posture.compute_error(configuration)).max() < 0.7 * off


def test_caps_come_first_whatever_the_order_given(world):
    configuration = world.configuration(world.inside())
    tips = mink.CollisionAvoidanceLimit(
        world.model, [(["f1_tip"], ["f2_tip"])], collision_detection_distance=10.0
    )
    place = world.tasks(configuration)[0]
    levels = ik_levels(
        configuration,
        [place],
        DT,
        limits=[tips, *world.limits],
        constraints=[world.couplings],
    )
    assert [level.name for level in levels] == [
        "VelocityLimit",
        "ConfigurationLimit",
        "CollisionAvoidanceLimit",
        "EqualityConstraintTask",
        "FrameTask",
    ]
    assert len(levels[2].A) == 1
    assert (levels[0].upper == 1.0).all()  # caps are shares of themselves
    levels = ik_levels(configuration, [place], DT)
    assert [level.name for level in levels] == ["ConfigurationLimit", "FrameTask"]


# ---------------------------------------------------------------- arguments


def test_malformed_arguments_are_refused_by_name(world):
    configuration = world.configuration(world.inside())
    task = world.tasks(configuration)[0]
    energy = mink.KineticEnergyRegularizationTask(cost=1.0)
    _, stranger = floating()
    other = mink.PostureTask(mujoco.MjModel.from_xml_string(FLOATING), cost=1.0)
    other.set_target(np.zeros(12))
    lost = mink.PostureTask(world.model, cost=1.0)
    lost.set_target(np.full(15, np.nan))
    nv = configuration.nv
    for message, priorities, given in (
        ("dt must be", [task], {"dt": 0.0}),
        ("dt must be", [task], {"dt": np.nan}),
        ("damping must be", [task], {"damping": -1.0}),
        ("unknown solver 'nonesuch'", [task], {"solver": "nonesuch"}),
        ("priorities must be a list", task, {}),
        (r"priorities must hold mink\.BaseTask objects; got str", [["palm"]], {}),
        (r"priorities must hold .* got VelocityLimit", [[world.limits[1]]], {}),
        (r"limits must hold mink\.Limit objects; got FrameTask", [task], {"limits": [task]}),
        (r"constraints must hold mink\.Task .* KineticEnergy", [task], {"constraints": [energy]}),
        ("NaN", [lost], {}),
        ("negative eigenvalue", [Pull(-np.eye(nv), np.zeros(nv))], {}),
        ("falls for ever", [Pull(np.zeros((nv, nv)), np.ones(nv))], {}),
        ("not finite", [Pull(np.full((nv, nv), np.inf), np.ones(nv))], {}),
        (r"VelocityLimit .* another model", [task], {"limits": [_limit_of_another_model()]}),
    ):
        with pytest.raises(InputError, match=message):
            solve_ik(configuration, priorities, **({"dt": DT} | given))
    with pytest.raises(mink.InvalidFrame):
        solve_ik(configuration, [stranger], DT)


@pytest.mark.parametrize("setting", ["dt", "damping"])
@pytest.mark.parametrize("value", ["soon", None, [0.1, 0.1]])
def test_a_time_or_a_damping_that_is_no_number_is_refused_by_name(world, setting, value):
    configuration = world.configuration(world.inside())
    with pytest.raises(InputError, match=f"{setting} must be a number"):
        solve_ik(configuration, world.tasks(configuration), **({"dt": DT} | {setting: value}))


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_a_motion_that_is_not_certified_is_not_returned(world, monkeypatch, damping):
    solve = HQP.solve

    def doubtful(self, levels, warm=None):
        return replace(solve(self, levels, warm), certified=False, failed=("why",))

    monkeypatch.setattr(HQP, "solve", doubtful)
    configuration = world.configuration(world.inside())
    with pytest.raises(SolverError, match="not certified, and so not used: why"):
        solve_ik(configuration, world.tasks(configuration), DT, damping=damping)


def _limit_of_another_model() -> mink.Limit:
    return mink.VelocityLimit(mujoco.MjModel.from_xml_string(FLOATING), {"elbow": 1.0})


def test_safety_break_refuses_a_start_outside_the_ranges_as_mink_does(world):
    configuration = world.configuration(world.outside())
    tasks = world.tasks(configuration)
    with pytest.raises(mink.NotWithinConfigurationLimits):
        solve_ik(configuration, tasks, DT, safety_break=True)
    assert np.isfinite(solve_ik(configuration, tasks, DT, safety_break=False)).all()


def test_nothing_asked_is_answered_by_standing_still(world):
    configuration = world.configuration(world.inside())
    for given in ({}, {"limits": world.limits}, {"limits": []}):
        assert np.abs(solve_ik(configuration, [[]], DT, **given)).max() < EXACT
    assert np.abs(solve_ik(configuration, [], DT)).max() < EXACT


def test_opposite_rows_of_a_limit_become_one_that_may_ask_for_one_value(world: Any) -> None:
    class Told(mink.Limit):
        def __init__(self, G: Any, h: Any) -> None:
            self.rows = np.array(G, dtype=float), np.array(h, dtype=float)

        def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
            return mink.Constraint(*self.rows)

    configuration = world.configuration(world.inside())
    one, two = np.eye(configuration.nv)[:2]

    def level(G: Any, h: Any) -> Any:
        (found,) = ik_levels(configuration, [], DT, limits=[Told(G, h)])
        return found

    held = level([one, two, -one, -two], [0.3, 0.2, -0.3, 0.1])
    np.testing.assert_array_equal(held.A, [one, two])
    np.testing.assert_array_equal(held.lower, [0.3, -0.1])
    np.testing.assert_array_equal(held.upper, [0.3, 0.2])
    for G, h in (
        ([one, -one], [0.1, -0.2]),  # they contradict one another: each as it is
        ([one, two], [0.1, 0.2]),
        ([one, -one, two], [0.1, 0.2, 0.3]),
    ):
        apart = level(G, h)
        np.testing.assert_array_equal(apart.A, G)
        assert (apart.lower == -np.inf).all()
        np.testing.assert_array_equal(apart.upper, h)
    open_ = level([one, two, -one, -two], [0.3, np.inf, 0.1, 0.2])
    np.testing.assert_array_equal(open_.upper, [0.3, 0.1, 0.2])
