"""Torques at rest: what contact forces ask of the joints, what weight takes, what motors have."""

from __future__ import annotations

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.grasp import Grasp
from hqp_grasp.world.robot import Robot


def contact_jacobian(robot: Robot, grasp: Grasp) -> np.ndarray:
    """∂x/∂q (3k, n) [m/rad] of the links' points that touch, at any link of the robot.

    `grasp.jacobian` follows the centre of a round tip; a force that is not along the normal turns
    the tip about it.
    """
    model, data = robot.model, robot._at(robot.require_q("Grasp.q", grasp.q))
    mujoco.mj_comPos(model, data)
    J = np.empty((3 * grasp.k, model.nv))
    for i, contact in enumerate(grasp.contacts):
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, contact.body)
        if body < 0:
            raise InputError(
                f"contact {i} touches with body {contact.body!r}, which {robot.description.name} "
                "lacks: robot.grasp(q, contacts) names the links of its contact points"
            )
        mujoco.mj_jac(model, data, J[3 * i : 3 * i + 3], None, contact.position, body)
    return J @ robot.coupling


def weight_torque(robot: Robot, q: np.ndarray) -> np.ndarray:
    """What holds the robot's own weight at q (n,) [N·m, N at slides].

    All of it counts, also that of bodies with `gravcomp`: on a real arm, what compensates gravity
    is the same motors. What the joints have left for contacts is less by it, never more than is.
    """
    data = robot._at(robot.require_q("weight_torque: q", q))
    mujoco.mj_comPos(robot.model, data)
    return robot.coupling.T @ holding(robot.model, data)


def holding(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Torques (N,) that hold the model's weight at rest, after mj_kinematics and mj_comPos."""
    torque = np.zeros(model.nv)
    mujoco.mj_rne(model, data, 0, torque)
    return torque


def torque_limits(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Least and most that the motors of each independent joint give, (n,) each [N·m, N].

    From the actuators' `forcerange` and gear, where they drive joints or fixed tendons, and from
    the joints' `actuatorfrcrange`; a motor's `ctrlrange` limits it too. Raises ModelError for a
    joint that moves a contact point and has no such limit, or that shares a motor with another one.
    """
    model, C = robot.model, robot.coupling
    low, high = np.zeros(robot.n), np.zeros(robot.n)
    driven = np.zeros(robot.n, dtype=bool)
    about = robot.description.name
    for a in range(model.nu):
        moved = C.T @ _lever(model, a)
        joints = np.flatnonzero(moved)
        if len(joints) > 1:
            names = ", ".join(repr(robot.joints[j]) for j in joints)
            raise ModelError(
                f"actuator {model.actuator(a).name!r} of {about} drives {names} at once: limits "
                "on torques here are each joint's own"
            )
        for j in joints:
            ends = sorted(moved[j] * _strength(model, a))
            low[j], high[j], driven[j] = low[j] + ends[0], high[j] + ends[1], True
    for full in np.flatnonzero(model.jnt_actfrclimited):
        (joints,) = np.nonzero(C[full])
        if len(joints) == 1:
            ends = sorted(C[full, joints[0]] * model.jnt_actfrcrange[full])
            low[joints[0]] = max(low[joints[0]], ends[0])
            high[joints[0]] = min(high[joints[0]], ends[1])
    bare = ~(driven & np.isfinite(low) & np.isfinite(high)) & ~robot.idle
    if bare.any():
        names = ", ".join(robot.joints[j] for j in np.flatnonzero(bare))
        raise ModelError(
            f"{about} says no force limit for the motors of: {names}; give their actuators a "
            'forcerange in the model, as <position joint="…" forcerange="-2 2"/>'
        )
    return low, high


def _strength(model: mujoco.MjModel, actuator: int) -> np.ndarray:
    """Least and most (2,) that an actuator pulls with, before its gear."""
    least, most = -np.inf, np.inf
    if model.actuator_forcelimited[actuator]:
        least, most = model.actuator_forcerange[actuator]
    plain = model.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_FIXED)
    plain &= model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_NONE)
    if plain and model.actuator_ctrllimited[actuator]:  # a motor: its force is its control
        low, high = sorted(model.actuator_gainprm[actuator, 0] * model.actuator_ctrlrange[actuator])
        least, most = max(least, low), min(most, high)
    return np.array([least, most])


def _lever(model: mujoco.MjModel, actuator: int) -> np.ndarray:
    """Torque (N,) on each joint by a unit of the actuator's force."""
    lever = np.zeros(model.njnt)
    target, gear = int(model.actuator_trnid[actuator, 0]), model.actuator_gear[actuator, 0]
    kind = model.actuator_trntype[actuator]
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        lever[target] = gear
    elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
        first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
        for wrap in range(first, first + count):
            if model.wrap_type[wrap] == int(mujoco.mjtWrap.mjWRAP_JOINT):
                lever[model.wrap_objid[wrap]] += gear * model.wrap_prm[wrap]
    return lever
