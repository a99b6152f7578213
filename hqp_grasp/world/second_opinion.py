"""Whether Pinocchio reads a robot's files as MuJoCo does."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from hqp_grasp.world.compiling import compiled_spec
from hqp_grasp.world.description import ModelFile
from hqp_grasp.world.statics import holding

BODY = pin.FrameType.BODY  # a joint may be named like its body
POSTURES = 3  # random ones that are compared


@dataclass(frozen=True)
class Agreement:
    """How far two readings of one file are apart, over random postures."""

    file: str
    position: float = 0.0  # [m] of any body
    jacobian: float = 0.0  # [m/rad] of any body's origin
    weight: float = 0.0  # [N·m, N at slides] that holds the robot's own weight at any joint
    reason: str = ""  # why there is no comparison; empty where there is


def second_opinion(part: ModelFile) -> Agreement:
    """Compare bodies, their Jacobians and their weight in MuJoCo and Pinocchio.

    That is at random postures.
    """
    name = part.file.name
    model = compiled_spec(part.spec(), f"{name} does not compile")
    if not model.njnt:
        return Agreement(name, reason="nothing in it moves")
    if model.nq != model.njnt:
        return Agreement(name, reason="not compared: a joint is neither hinge nor slide")
    if part.root:
        return Agreement(name, reason="not compared: Pinocchio reads all of its root bodies")
    if part.degrees is not None and not part.is_urdf:
        return Agreement(name, reason="not compared: Pinocchio reads its angles as the file says")
    build = pin.buildModelFromUrdf if part.is_urdf else pin.buildModelFromMJCF
    # Pinocchio raises whatever its parser meets; it is told, as a robot runs without it.
    try:
        other = build(str(part.file))
    except Exception as error:
        return Agreement(name, reason=f"Pinocchio does not read it: {error}".splitlines()[0])
    joints = [model.joint(j).name for j in range(model.njnt)]
    missing = [joint for joint in joints if not other.existJointName(joint)]
    if missing or other.nv != model.nv:
        return Agreement(name, reason=f"Pinocchio finds {other.nv} joints, MuJoCo {model.nv}")
    at = [other.joints[other.getJointId(joint)] for joint in joints]
    bodies = [b for b in range(1, model.nbody) if other.existFrame(model.body(b).name, BODY)]
    data, scratch = mujoco.MjData(model), other.createData()
    rng = np.random.default_rng(0)
    low, high = np.where(model.jnt_limited, model.jnt_range.T, [[-1.0], [1.0]])
    worst = np.zeros(3)
    for _ in range(POSTURES):
        data.qpos[:] = rng.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        q = pin.neutral(other)
        for joint, angle in zip(at, data.qpos, strict=True):
            turns = joint.nq == 2  # a hinge without range: cosine and sine
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                [np.cos(angle), np.sin(angle)] if turns else angle
            )
        pin.computeJointJacobians(other, scratch, q)
        pin.updateFramePlacements(other, scratch)
        # Pinocchio drops the pose of a root that stands still: both are seen from there.
        root = int(model.body_rootid[model.jnt_bodyid[0]])
        known = other.existFrame(model.body(root).name, BODY) and not model.body_jntnum[root]
        ours = _pose(data.xpos[root], data.xmat[root]) if known else pin.SE3.Identity()
        theirs = pin.SE3.Identity()
        if known:
            theirs = scratch.oMf[other.getFrameId(model.body(root).name, BODY)]
        for body in bodies:
            frame = other.getFrameId(model.body(body).name, BODY)
            J = np.zeros((3, model.nv))
            mujoco.mj_jacBody(model, data, J, None, body)
            axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            J_other = np.reshape(pin.getFrameJacobian(other, scratch, frame, axes), (6, -1))[:3]
            J_other = J_other[:, [joint.idx_v for joint in at]]
            x = ours.rotation.T @ (data.xpos[body] - ours.translation)
            apart = np.abs(theirs.actInv(scratch.oMf[frame]).translation - x).max()
            turned = np.abs(theirs.rotation.T @ J_other - ours.rotation.T @ J).max()
            worst[:2] = np.maximum(worst[:2], [apart, turned])
        other.gravity.linear = theirs.rotation @ ours.rotation.T @ model.opt.gravity
        held = pin.computeGeneralizedGravity(other, scratch, q)[[joint.idx_v for joint in at]]
        worst[2] = max(worst[2], float(np.abs(held - holding(model, data)).max()))
    position, jacobian, weight = worst.tolist()
    return Agreement(name, position, jacobian, weight)


def _pose(p: np.ndarray, R: np.ndarray) -> pin.SE3:
    return pin.SE3(R.reshape(3, 3).copy(), p.copy())
