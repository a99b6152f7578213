"""What kinematics and statics of one URDF cost, by Pinocchio and by MuJoCo, through Python.

    python benchmarks/kinematics.py

The URDF is made here: an arm of seven joints with three fingers of two, a ball at the end of each.
Each cell is the processor time of one call [µs], the median of 25 rounds of 100 postures, the three
taken in turn; `Robot` is what hqp_grasp calls, with couplings and checks of its arguments around
MuJoCo's own. Answers are compared first.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

import hqp_grasp as hg
from hqp_grasp.world.robot import compiled, described
from hqp_grasp.world.statics import weight_torque

ROUNDS, POSTURES = 25, 100
INERTIAL = (
    '<inertial><mass value="{m}"/><origin xyz="0 0 0.05"/><inertia ixx="{i}" iyy="{i}" izz="{i}" '
    'ixy="0" ixz="0" iyz="0"/></inertial>'
)
JOINT = (
    '<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{x:.4f} {y:.4f} {z}" rpy="0 0 {yaw:.4f}"/><axis xyz="{axis}"/>'
    '<limit lower="-1.5" upper="1.5" effort="10" velocity="1"/></joint>'
)
BALL = (
    '<collision><origin xyz="0 0 0.05"/><geometry><sphere radius="0.009"/></geometry></collision>'
)
AXES = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")


def urdf() -> str:
    """An arm with three fingers."""
    parts = ['<robot name="arm"><link name="base"/>']
    parent = "base"
    for i, axis in enumerate(AXES):
        parts.append(f'<link name="link{i}">{INERTIAL.format(m=2.0, i=0.01)}</link>')
        place = {"x": 0.0, "y": 0.0, "z": 0.15, "yaw": 0.0}
        parts.append(
            JOINT.format(name=f"j{i}", parent=parent, child=f"link{i}", axis=axis, **place)
        )
        parent = f"link{i}"
    for f, turn in enumerate(np.radians([0.0, 120.0, 240.0])):
        inner, outer = f"inner{f}", f"outer{f}"
        light = INERTIAL.format(m=0.1, i=1e-4)
        parts.append(
            f'<link name="{inner}">{light}</link><link name="{outer}">{light}{BALL}</link>'
        )
        place = {"x": 0.05 * np.cos(turn), "y": 0.05 * np.sin(turn), "z": 0.1, "yaw": turn}
        bends = {"axis": "0 -1 0"}
        parts.append(JOINT.format(name=inner, parent=parent, child=inner, **place, **bends))
        place = {"x": 0.0, "y": 0.0, "z": 0.07, "yaw": 0.0}
        parts.append(JOINT.format(name=outer, parent=inner, child=outer, **place, **bends))
    return "".join(parts) + "</robot>"


def by_mujoco(model: mujoco.MjModel) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """The same from MuJoCo's own functions."""
    data = mujoco.MjData(model)
    tips = [model.body(f"outer{f}").id for f in range(3)]
    at = [model.geom(int(model.body_geomadr[b])).id for b in tips]

    def place(q: np.ndarray) -> None:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)

    def centers(q: np.ndarray) -> np.ndarray:
        place(q)
        return data.geom_xpos[at]

    def jacobian(q: np.ndarray) -> np.ndarray:
        place(q)
        mujoco.mj_comPos(model, data)
        J = np.empty((9, model.nv))
        for i in range(3):
            mujoco.mj_jac(model, data, J[3 * i : 3 * i + 3], None, data.geom_xpos[at[i]], tips[i])
        return J

    def gravity(q: np.ndarray) -> np.ndarray:
        place(q)
        mujoco.mj_comPos(model, data)
        torque = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, torque)
        return torque

    def inverse_dynamics(q: np.ndarray) -> np.ndarray:
        place(q)
        mujoco.mj_comPos(model, data)
        data.qvel[:], data.qacc[:] = q, -q
        mujoco.mj_comVel(model, data)
        torque = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 1, torque)
        data.qvel[:] = 0.0
        return torque

    return {f.__name__.replace("_", " "): f for f in (centers, jacobian, gravity, inverse_dynamics)}


def by_pinocchio(path: Path) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """The same from Pinocchio, which reads the URDF itself."""
    model = pin.buildModelFromUrdf(str(path))
    ball = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.05]))
    joints = [model.getJointId(f"outer{f}") for f in range(3)]
    tips = [
        model.addFrame(pin.Frame(f"tip{f}", joint, 0, ball, pin.FrameType.OP_FRAME))
        for f, joint in enumerate(joints)
    ]
    data, axes = model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED

    def centers(q: np.ndarray) -> np.ndarray:
        pin.forwardKinematics(model, data, q)
        return np.array([pin.updateFramePlacement(model, data, tip).translation for tip in tips])

    def jacobian(q: np.ndarray) -> np.ndarray:
        pin.computeJointJacobians(model, data, q)
        J = np.empty((9, model.nv))
        for i, tip in enumerate(tips):
            pin.updateFramePlacement(model, data, tip)
            J[3 * i : 3 * i + 3] = pin.getFrameJacobian(model, data, tip, axes)[:3]
        return J

    def gravity(q: np.ndarray) -> np.ndarray:
        return np.array(pin.computeGeneralizedGravity(model, data, q))

    def inverse_dynamics(q: np.ndarray) -> np.ndarray:
        return np.array(pin.rnea(model, data, q, q, -q))

    return {f.__name__.replace("_", " "): f for f in (centers, jacobian, gravity, inverse_dynamics)}


def timed(call: Callable[[np.ndarray], np.ndarray], postures: np.ndarray) -> float:
    """Processor time of one call [µs], the mean over `postures`."""
    begin = time.thread_time()
    for q in postures:
        call(q)
    return 1e6 * (time.thread_time() - begin) / len(postures)


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(urdf())
        tips = "".join(f'[[contact_points]]\nlink = "outer{f}"\n' for f in range(3))
        (Path(folder) / "arm.toml").write_text('model = "arm.urdf"\n' + tips)
        about = described(Path(folder) / "arm.toml")
        robot = hg.Robot(about, compiled(about))
        pinocchio = by_pinocchio(path)
    mujoco_ = by_mujoco(robot.model)
    ours = {
        "centers": robot.centers,
        "jacobian": robot.jacobian,
        "gravity": lambda q: weight_torque(robot, q),
    }
    postures = np.random.default_rng(0).uniform(-1.0, 1.0, (POSTURES, robot.n))
    print(f"{robot.n} joints, {len(robot.flexion)} tips; µs a call\n")
    print(f"{'':18}{'Robot':>8}{'MuJoCo':>8}{'Pinocchio':>11}  largest difference")
    for name in mujoco_:
        calls = [c[name] for c in (ours, mujoco_, pinocchio) if name in c]
        apart = max(abs(a(q) - calls[-1](q)).max() for a in calls[:-1] for q in postures[:10])
        rounds = np.array([[timed(call, postures) for call in calls] for _ in range(ROUNDS)])
        cells = [f"{t:.1f}" for t in np.median(rounds, axis=0)]
        first, *rest = cells if len(cells) == 3 else ["–", *cells]
        print(f"{name:18}{first:>8}{rest[0]:>8}{rest[1]:>11}  {apart:.0e}")


if __name__ == "__main__":
    main()
