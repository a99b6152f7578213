"""The bench on which grasps are tested: a hand that presses, and an object that is pulled at."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.physics import SUPPORT, Physics, palm_sensors, servos, simulated_model
from hqp_grasp.world.scene import Scene

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
CONTROL = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
NOSLIP = 2  # iterations after each step that keep edges from creeping, as DexGraspBench has them
DEEPEST = 1e-3  # [m] that a grasp to be tested may have a link in the object
CARRIED = 1 << 30  # collision bit of the object and what it stands on, of nothing else
PRESSED = 1e-3  # [N] below which a contact counts as none


@dataclass(frozen=True, eq=False)
class Touching:
    """What presses on the object, now."""

    positions: np.ndarray  # (k, 3) [m] where each contact point presses, world; NaN: nowhere
    normals: np.ndarray  # (k, 3) outward from the object
    forces: np.ndarray  # (k, 3) [N] on the object, world
    elsewhere: np.ndarray  # (3,) [N] by other links and the support

    @property
    def normal_force(self) -> np.ndarray:
        """By which each contact presses (k,) [N]."""
        return np.asarray(-(np.nan_to_num(self.normals) * self.forces).sum(axis=1))


class Bench:
    """A scene in full dynamics, its object free, in one state that the calls move on.

    Servos stay where they were told: a finger is a spring, as one with a position servo is. Raises
    InputError where the hand begins in the object.
    """

    def __init__(self, scene: Scene, grasp: Grasp, physics: Physics) -> None:
        self.robot = robot = scene.articulated
        self.model = model = simulated_model(scene, physics, feeling=False)
        model.opt.noslip_iterations = NOSLIP
        self.data = data = mujoco.MjData(model)
        self._rollout = Rollout(nthread=0)
        driven = np.flatnonzero(~robot.idle)
        names = tuple(robot.joints[j] for j in driven)
        self._servo = servos(model, names)
        self._driven = driven
        self.kp = np.ones(robot.n)  # [N·m/rad]
        self.kp[driven] = model.actuator_gainprm[self._servo, 0]
        self.strength = np.zeros(robot.n)  # [N·m]
        self.strength[driven] = model.actuator_forcerange[self._servo, 1]
        every = [robot.model.joint(j).name for j in range(robot.model.njnt)]
        there = {model.joint(j).name for j in range(model.njnt)}
        kept = [j for j, name in enumerate(every) if name in there]
        full = robot.coupling @ grasp.q + robot.offset
        data.qpos[[model.joint(every[j]).qposadr[0] for j in kept]] = full[kept]
        self._qpos = np.array([model.joint(name).qposadr[0] for name in names])
        self._standing = grasp.q.copy()
        self.told = grasp.q.copy()  # (n,) [rad] the servos' targets
        self._object = model.body(OBJECT).id
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        self._things = {
            int(g) for g in np.flatnonzero(collides & (model.geom_bodyid == self._object))
        }
        self._tips = [{model.geom(robot.model.geom(g).name).id for g in gs} for gs in robot.geoms]
        self._support = model.geom(SUPPORT).id
        things = sorted(self._things)
        for bits in (model.geom_contype, model.geom_conaffinity):
            bits[self._support] = CARRIED  # it carries the object, and hands reach past it
            bits[things] |= CARRIED
        self._pose = palm_sensors(model)
        data.ctrl[self._servo] = self.told[driven]
        mujoco.mj_forward(model, data)
        self._refuse_overlap()
        self.state = np.zeros(mujoco.mj_stateSize(model, STATE))
        mujoco.mj_getState(model, data, self.state, STATE)
        self.warm = np.zeros(model.nv)

    def _refuse_overlap(self) -> None:
        for contact in self.data.contact[: self.data.ncon]:
            one, other = contact.geom.tolist()
            links = {one, other} - self._things
            if len(links) == 1 and self._support not in links and contact.dist < -DEEPEST:
                raise InputError(
                    f"{self.model.geom(links.pop()).name} is {-1e3 * contact.dist:.1f} mm in the "
                    "object: a grasp is judged from where its contacts touch"
                )

    def saved(self) -> tuple[np.ndarray, np.ndarray]:
        """The state, to return to."""
        return self.state.copy(), self.warm.copy()

    def restore(self, state: tuple[np.ndarray, np.ndarray]) -> None:
        """Return to a state."""
        self.state, self.warm = state[0].copy(), state[1].copy()

    @property
    def q(self) -> np.ndarray:
        """Independent joints (n,) [rad]."""
        q = self._standing.copy()
        q[self._driven] = self.state[1 + self._qpos]
        return q

    def run(
        self, told: np.ndarray, duration: float, wrench: np.ndarray | None = None
    ) -> np.ndarray:
        """Lead the servos to `told` (n,) [rad] over `duration` [s]; return the object's poses.

        `wrench` (T, 6) [N, N·m] acts on the object at its centre of mass, world, step by step.
        Poses (T, 7) [m, quaternion] are in the palm's frame.
        """
        steps = max(1, round(duration / self.model.opt.timestep))
        nu = self.model.nu
        control = np.zeros((1, steps, nu + 6 * self.model.nbody))
        share = (np.arange(1, steps + 1) / steps)[:, None]
        path = self.told + share * (told - self.told)
        control[0, :, self._servo] = path[:, self._driven].T
        if wrench is not None:
            at = nu + 6 * self._object
            control[0, :, at : at + 6] = wrench
        states = np.empty((1, steps, len(self.state)))
        sensors = np.empty((1, steps, self.model.nsensordata))
        self._rollout.rollout(
            [self.model],
            [self.data],
            self.state[None],
            control,
            control_spec=CONTROL,
            skip_checks=True,
            nstep=steps,
            initial_warmstart=self.warm[None],
            state=states,
            sensordata=sensors,
        )
        self.state, self.warm = states[0, -1].copy(), self.data.qacc_warmstart.copy()
        self.told = told.copy()
        return sensors[0][:, self._pose]

    def remove_support(self) -> None:
        """Nothing stands below the object any more."""
        self.model.geom_contype[self._support] = self.model.geom_conaffinity[self._support] = 0

    def remove_gravity(self) -> None:
        """Nothing weighs any more."""
        self.model.opt.gravity[:] = 0.0

    def _forward(self) -> mujoco.MjData:
        mujoco.mj_setState(self.model, self.data, self.state, STATE)
        self.data.qacc_warmstart[:] = self.warm
        mujoco.mj_forward(self.model, self.data)
        return self.data

    @property
    def height(self) -> float:
        """Of the object's centre of mass [m], world."""
        return float(self._forward().xipos[self._object, 2])

    def touching(self) -> Touching:
        """What presses on the object, now."""
        data, k = self._forward(), len(self._tips)
        forces, places, normals = np.zeros((k, 3)), np.zeros((k, 3)), np.zeros((k, 3))
        pressed, elsewhere = np.zeros(k), np.zeros(3)
        wrench = np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            one, other = contact.geom.tolist()
            if not {one, other} & self._things:
                continue
            mujoco.mj_contactForce(self.model, data, i, wrench)
            # The frame's first axis points from geom1 to geom2, the force is the one on geom2.
            on_thing = 1.0 if other in self._things else -1.0
            frame = contact.frame.reshape(3, 3)
            force = on_thing * (frame.T @ wrench[:3])
            link = one if other in self._things else other
            at = next((i for i, tips in enumerate(self._tips) if link in tips), None)
            if at is None:
                elsewhere += force
                continue
            forces[at] += force
            pressed[at] += wrench[0]
            places[at] += wrench[0] * contact.pos
            normals[at] -= wrench[0] * on_thing * frame[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            there = np.where(pressed > PRESSED, pressed, np.nan)[:, None]
            places = places / there
            normals = normals / np.linalg.norm(normals / there, axis=1)[:, None] / there
        return Touching(places, normals, forces, elsewhere)

    def grasp(self) -> Grasp | None:
        """The grasp as it is, forces included; None unless every contact point touches."""
        touching = self.touching()
        if np.isnan(touching.positions).any():
            return None
        q = self.q
        levers = touching.positions - self.robot.centers(q)
        contacts = [
            Contact(x, n, wrench=np.concatenate([-f, np.cross(lever, -f)]))
            for x, n, f, lever in zip(
                touching.positions, touching.normals, touching.forces, levers, strict=True
            )
        ]
        return self.robot.grasp(q, contacts)
