"""A driver whose hand is simulated: MuJoCo's full dynamics behind the door of a real one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from hqp_grasp.errors import InputError, instance, not_negative, one_of, positive
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.touch.driver import PRESS_RATE, DriverLimits, Readings
from hqp_grasp.touch.geometric import OVERLAP, RETREAT
from hqp_grasp.world.imperfections import SensorErrors
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.physics import (
    NOSLIP,
    Physics,
    foot,
    palm_sensors,
    round_tips,
    servos,
    simulated_model,
)
from hqp_grasp.world.scene import Scene

SAMPLING = 0.01  # [s] between readings
ZEROING = 0.05  # [s] of samples, from whose median closing counts the change of force
PEAK = 1.875  # a minimum-jerk ramp's fastest speed, by its mean
SPEED_SHARE = 0.8  # of a joint's speed limit that a move is planned with
CARRY_SPEED = 0.12  # [m/s] at which the arm carries the tips: a bump stays below the force limit
CLOSING_ACCELERATION = 20.0  # [rad/s²]
STALL = 0.015  # [rad] a closing joint stays behind its target by, beyond the servo's own lag
FOLLOWING = 0.05  # [rad] beside its target at which a joint is held by something: the hand stops
FORCE_RATE = 5.0  # [N/s] by which the held force follows what is asked
FORCE_GAIN = 0.5  # share of the force's error that one cycle of holding takes away
HOLDING_SPEED = 0.3  # [rad/s] that holding corrects by, at most
LEAD = 2.0  # times the servo's give at the held force, by which a target leads its joint at most
GUARD = 0.6  # share of the force limit at which the driver stops
GRIP_GUARD = 0.9  # the same of the grip's: it grows slowly, for PRESS_RATE bounds it
MARGIN = 5e-3  # [rad] from the ends of its range a joint turns back: servos swing over
BRAKING = 0.06  # [s] a stop takes, all joints together: one that stands while others move may press
SILENT = 5  # samples of the fast loop, the same to the last bit, after which a sensor is dead
STARTLE = 1.0  # [N] more than at its beginning, a move in free air stops: a bump has momentum
FOLLOWED = 0.05  # share of the largest torque asked to which every joint follows its own
RESISTING = 0.5  # share of its torque below which a pressed joint meets nothing that resists
GIVING = 0.3  # [s] after which such a joint stops the hand, once its torque could be there
MOVING, REACTING = 0.4, 0.05  # [s] in one call of the simulator, and while fingers press
IDLE, CLOSING, HOLDING = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Truth:
    """What is, as only a simulation knows."""

    grasp: Grasp | None  # the true contacts; None unless every tip touches the object
    forces: np.ndarray  # (k, 3) [N] that the object applies to each tip, world
    R_world_tip: np.ndarray  # (k, 3, 3) where the tips really point
    place: np.ndarray  # (7,) the object's [m] and quaternion, world
    in_palm: np.ndarray  # (7,) the same, in the palm's frame; NaN for a fixed object
    moved: float  # [m] the object's middle, since the hand was placed
    turned: float  # [rad] the object
    other_links: tuple[str, ...]  # geoms beside the tips that touch the object
    table_tips: tuple[str, ...]  # tips that touch what the object stands on


class SimulatedHand:
    """`Driver` of a robot's position servos in a scene, in MuJoCo's full dynamics.

    With links="pass" only tips meet the object. `rng` draws the imperfections. Joints that move no
    contact point, such as those of another arm, stand at home, braked.

    Phases run in single calls of the simulator, whose readings are searched afterwards: where
    something happened, the simulation returns to that step and goes on from there. So the loop
    reacts at every step, and no Python runs in between.
    """

    def __init__(
        self,
        scene: Scene,
        physics: Physics | None = None,
        links: str = "block",
        rng: np.random.Generator | None = None,
        force_limit: float = 15.0,  # [N] as the BarrettHand presses
        watchdog: float = 1.0,  # [s]
        grip_limit: float = 20.0,  # [N] as the BarrettHand bears
    ) -> None:
        instance("SimulatedHand.scene", scene, Scene)
        one_of("links", links, ("pass", "block"))
        physics = Physics() if physics is None else physics
        instance("SimulatedHand.physics", physics, Physics)
        rng = np.random.default_rng(0) if rng is None else rng
        instance("SimulatedHand.rng", rng, np.random.Generator)
        force_limit = positive("SimulatedHand.force_limit", force_limit)
        grip_limit = not_negative("SimulatedHand.grip_limit", grip_limit)
        about, timestep = physics.imperfections, physics.timestep
        self.robot = scene.articulated
        k, n = len(self.robot.flexion), self.robot.n
        self._closing = self.robot.closing  # (k, n)
        self._free = physics.support != "fixed"
        self.table = foot(scene)[0] if physics.support == "table" else None  # [m] its height
        self.model = simulated_model(scene, physics, links)
        self._data = mujoco.MjData(self.model)
        self._rollout = Rollout(nthread=0)
        self._dt = timestep
        self._every = max(1, round(SAMPLING / timestep))
        self._zeroing = max(self._every, round(ZEROING / timestep))
        model, robot = self.model, self.robot
        names = [robot.model.joint(j).name for j in range(robot.model.njnt)]
        simulated = {model.joint(j).name for j in range(model.njnt)}
        self._all = np.flatnonzero([name in simulated for name in names])
        self._at = np.array([model.joint(names[j]).qposadr[0] for j in self._all])
        self._driven = np.flatnonzero(~robot.idle)
        driven = tuple(robot.joints[j] for j in self._driven)
        # A state is MuJoCo's, then the joints that stand braked, then their speed.
        self._size = size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self._standing = np.append(robot.home[robot.idle], 0.0)
        self._q, self._v = np.zeros(n, dtype=int), np.full(n, size + len(self._standing) - 1)
        self._q[robot.idle] = size + np.arange(robot.idle.sum())
        self._q[self._driven] = [1 + model.joint(j).qposadr[0] for j in driven]
        self._v[self._driven] = [1 + model.nq + model.joint(j).dofadr[0] for j in driven]
        self._servo = servos(model, driven)
        self._damping = model.actuator_biasprm[:, 2].copy()
        self._kp, self._lag = np.ones(n), np.zeros(n)
        self._kp[self._driven] = kp = model.actuator_gainprm[self._servo, 0]
        self._lag[self._driven] = (
            -model.actuator_biasprm[self._servo, 2] / kp
        )  # [s] behind a target
        points = robot.description.contact_points
        self._tips = [model.geom(name).id for name in round_tips(robot)]
        self._sites = [model.site(p.site).id for p in points]
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        thing = model.geom_bodyid == model.body(OBJECT).id
        self._objects = {int(g) for g in np.flatnonzero(thing & collides)}
        fixed = (0, model.body(OBJECT).id)
        self._hand = {g for g in range(model.ngeom) if model.geom_bodyid[g] not in fixed}
        self._passing = [
            g for g in sorted(self._hand - set(self._tips)) if links == "pass" and collides[g]
        ]
        first = model.sensor(f"{points[0].name} touch force").adr[0]
        self._wrench = slice(first, first + 6 * k)
        first = model.sensor(f"{driven[0]} torque").adr[0]
        self._torque = slice(first, first + len(driven))
        torque = robot.model.actuator_forcerange[servos(robot.model, robot.joints), 1]
        self.limits = DriverLimits(
            robot.q_lower,
            robot.q_upper,
            robot.velocity,
            torque,
            force_limit,
            watchdog,
            grip_limit,
        )
        self._lower, self._upper = robot.q_lower + MARGIN, robot.q_upper - MARGIN
        self.rate = 1.0 / (self._every * timestep)
        self._rng = rng
        self._arm = np.isin(np.arange(n), robot.arm)
        self._fingers = np.flatnonzero(~self._arm & ~robot.idle)  # joints that press
        self._errors = SensorErrors(about, k, self._arm, self._rng)
        self._late = round(about.latency / timestep)
        self.simulated = 0  # steps in all
        # The largest of each since the hand was made, at any step.
        self.worst = {"range [rad]": 0.0, "speed share": 0.0, "torque share": 0.0, "force [N]": 0.0}
        self._asked: np.ndarray | None = None  # (f,) [N·m] of the fingers' joints, while pressing
        self.place(robot.home)

    # ------------------------------------------------------------ what only a simulation can

    def place(self, q: np.ndarray) -> None:
        """Put the hand at q (n,) [rad], at rest, its flexions opened, and the object in its place.

        They open by RETREAT, or as far as they go where that leaves the hand in the object. Raises
        InputError where it is in the object all the same.
        """
        robot, model, data = self.robot, self.model, self._data
        q = np.clip(robot.require_q("SimulatedHand.place: q", q), self._lower, self._upper)
        self._release()
        q = np.clip(q - RETREAT * self._closing.sum(axis=0), self._lower, self._upper)
        if self._put(q):
            q = np.clip(robot.opened(q), self._lower, self._upper)
            inside = self._put(q)
            if inside:
                raise InputError(
                    f"SimulatedHand.place: {inside}, with open fingers; begin further away from it"
                )
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self._state = np.append(np.zeros(self._size), self._standing)
        mujoco.mj_getState(model, data, self._state[: self._size], kind)
        self._warm = np.zeros(model.nv)
        self._goal = q.copy()  # (n,) [rad] the commanded posture, as encoders have it
        self._play = q.copy()  # (n,) [rad] what the joints are told of it
        self._ramp: tuple[np.ndarray, np.ndarray, int, int] | None = None  # from, to, step, steps
        self._going = np.zeros(len(q))  # (n,) [rad/s] of the goal
        self._braking = 0  # steps left
        k = len(self._tips)
        self._mode = [IDLE] * k
        self._speed = [0.0] * k  # [1/s] asked, along `closing`
        self._now = [0.0] * k  # [1/s] of the target along `closing`
        self._force = [0.0] * k  # [N] that ends closing, or is held
        self._aim = [0.0] * k  # [N] that holding follows now
        self._give = [0.0] * k  # of the servos at the tip, along `closing` [1/N]
        self._zero = np.zeros((k, 3))  # [N] at the call of `close`
        self._touched, self._stalled = np.zeros(k, bool), np.zeros(k, bool)
        self._guard = np.full(k, GUARD * self.limits.force)  # [N] at which the hand stops
        self._motors = np.zeros(len(q))  # (n,) [N·m] lately
        self._giving = np.zeros(len(self._fingers))  # [s] without resistance
        self._fault = ""
        still = -data.sensordata[self._wrench].reshape(1, k, 6)
        self._tail = np.repeat(still, self._late, axis=0)
        self._last = self._errors.wrench(np.zeros(1), still)  # the newest samples

    def _put(self, q: np.ndarray) -> str:
        """Put hand and object in their places; return which of its geoms is in what, if any."""
        robot, model, data = self.robot, self.model, self._data
        mujoco.mj_resetData(model, data)
        data.qpos[self._at] = (robot.coupling @ q + robot.offset)[self._all]
        data.ctrl[self._servo] = q[self._driven]
        mujoco.mj_forward(model, data)
        for contact in data.contact[: data.ncon]:
            one, other = contact.geom.tolist()
            hand = self._hand & {one, other}
            if len(hand) == 1 and contact.dist < 0.0:
                met = "object" if self._objects & {one, other} else "support"
                return f"{model.geom(*hand).name} is in the {met}"
        return ""

    def truth(self) -> Truth:
        """What is, now."""
        model, data = self.model, self._data
        state = self._state[: self._size]
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(model, data)
        k = len(self._tips)
        normals: list[np.ndarray | None] = [None] * k
        pressed, forces = [0.0] * k, np.zeros((k, 3))
        links, table = [], []
        for i in range(data.ncon):
            contact = data.contact[i]
            one, other = contact.geom.tolist()
            if self._objects & {one, other}:
                touching = other if one in self._objects else one
                wrench = np.zeros(6)
                mujoco.mj_contactForce(model, data, i, wrench)
                if touching in self._tips:
                    at = self._tips.index(touching)
                    frame = contact.frame.reshape(3, 3) * (1.0 if one in self._objects else -1.0)
                    forces[at] += frame.T @ wrench[:3]
                    if wrench[0] > pressed[at]:
                        pressed[at] = wrench[0]
                        normals[at] = frame[0] / np.linalg.norm(frame[0])
                elif touching in self._hand:
                    links.append(model.geom(touching).name)
            else:
                table += [
                    model.geom(tip).name
                    for tip, ground in ((one, other), (other, one))
                    if tip in self._tips and model.geom(ground).name == "support"
                ]
        for g in self._passing:
            if any(
                mujoco.mj_geomDistance(model, data, g, thing, 0.0, None) < -OVERLAP
                for thing in self._objects
            ):
                links.append(model.geom(g).name)
        grasp = None
        centers = data.site_xpos[self._sites]
        if all(normal is not None for normal in normals):
            contacts = [
                Contact(c - r * v, v)
                for c, r, v in zip(centers, self.robot.tip_radius, normals, strict=True)
                if v is not None
            ]
            grasp = self.robot.grasp(self._state[self._q], contacts, tuple(dict.fromkeys(links)))
        moved = turned = 0.0
        place = np.concatenate([data.body(OBJECT).xpos, data.body(OBJECT).xquat])
        in_palm = np.full(7, np.nan)
        if self._free:
            in_palm = data.sensordata[palm_sensors(model)].copy()
            pose = data.joint(OBJECT).qpos
            start = model.qpos0[model.joint(OBJECT).qposadr[0] :][:7]
            moved = float(np.linalg.norm(pose[:3] - start[:3]))
            turned = float(2.0 * np.arccos(min(1.0, abs(pose[3:] @ start[3:]))))
        R = data.site_xmat[self._sites].reshape(-1, 3, 3).copy()
        others = tuple(dict.fromkeys(links))
        return Truth(grasp, forces, R, place, in_palm, moved, turned, others, tuple(table))

    # ------------------------------------------------------------ the driver

    def move(self, q: np.ndarray, duration: float) -> float:
        """See Driver."""
        q = self.robot.require_q("SimulatedHand.move: q", q)
        positive("SimulatedHand.move: duration", duration)
        self._release()
        steps = self._start(q, duration)
        self._rest()
        self._guard = np.minimum(self._guard, np.linalg.norm(self._middle(), axis=1) + STARTLE)
        return steps * self._dt

    def carry(self, q: np.ndarray, duration: float) -> float:
        """See Driver."""
        q = self.robot.require_q("SimulatedHand.carry: q", q)
        positive("SimulatedHand.carry: duration", duration)
        if self._asked is None:
            if self._fault:
                return 0.0
            raise InputError("SimulatedHand.carry: the hand presses nothing; call press first")
        return self._start(np.where(self._arm, q, self._goal), duration) * self._dt

    def _start(self, q: np.ndarray, duration: float) -> int:
        """Start a ramp to q (n,) [rad]; return its steps."""
        to = np.clip(q + self._errors.miss(len(q)), self._lower, self._upper)
        least = np.abs(to - self._goal) / (SPEED_SHARE * self.limits.speed)
        carried = np.where(self._arm, to - self._goal, 0.0)
        path = [self.robot.centers(self._goal + s * carried) for s in (0.0, 0.5, 1.0)]
        way = np.linalg.norm(np.diff(path, axis=0), axis=2).sum(axis=0)
        least = PEAK * max(least.max(), way.max() / CARRY_SPEED)
        steps = int(np.ceil(max(duration, least) / self._dt))
        self._ramp, self._braking = (self._goal.copy(), to, 0, steps), 0
        self._fault = ""
        return steps

    def close(self, finger: int, speed: float, force: float) -> None:
        """See Driver."""
        if not 0 <= finger < len(self._tips):
            raise InputError(f"no finger {finger}; there are {len(self._tips)}, from 0 on")
        positive("SimulatedHand.close: speed", speed)
        self.limits.require_hold("SimulatedHand.close: force", force)
        self._release()
        self._fault = ""
        self._ramp, self._braking = None, 0
        self._guard[:] = GUARD * self.limits.force
        if self._mode[finger] != CLOSING:
            self._zero[finger] = np.median(self._last[:, finger, :3], axis=0)
            self._now[finger] = 0.0
        self._mode[finger] = CLOSING
        share = np.abs(self._closing[finger]) / self.limits.speed
        self._speed[finger] = min(speed, SPEED_SHARE / float(share.max()))
        self._force[finger] = force
        self._touched[finger] = self._stalled[finger] = False

    def hold(self, force: float) -> None:
        """See Driver."""
        self.limits.require_hold("SimulatedHand.hold: force", force)
        for i, mode in enumerate(self._mode):
            if mode == HOLDING:
                self._force[i] = force

    def press(self, torque: np.ndarray) -> None:
        """See Driver."""
        torque = self.limits.require_torque("SimulatedHand.press: torque", torque, self.robot.arm)
        if self._asked is None:
            if self._ramp is not None:
                self.stop()
            self._mode, self._now = [IDLE] * len(self._mode), [0.0] * len(self._mode)
            self._giving[:] = 0.0
            self._guard[:] = GRIP_GUARD * self.limits.grip
            self._damp(self.limits.torque / (SPEED_SHARE * self.limits.speed))
            self.model.opt.noslip_iterations = NOSLIP
            self._fault = ""
        self._asked = torque[self._fingers]

    def _damp(self, least: np.ndarray | float) -> None:
        """Give the fingers' servos their damping, and `least` (n,) [N·m·s/rad] where it is more.

        With the torque limit by the speed limit no joint is faster than that, whatever it loses.
        """
        servos = self._servo[np.isin(self._driven, self._fingers)]
        own = self._damping[servos]
        most = np.broadcast_to(least, self._kp.shape)[self._fingers]
        self.model.actuator_biasprm[servos, 2] = np.minimum(own, -most)

    def _release(self) -> None:
        """Press no more: the fingers stand where they are."""
        if self._asked is None:
            return
        self._asked = None
        self._damp(0.0)
        self.model.opt.noslip_iterations = 0
        self._goal[self._fingers] = self._measured()[self._fingers]
        self._goal = np.clip(self._goal, self._lower, self._upper)
        self._guard[:] = GUARD * self.limits.force

    def stop(self) -> None:
        """See Driver."""
        if self._going.any() and not any(self._mode):
            self._braking = self._braking or round(BRAKING / self._dt)
        self._ramp = None
        self._release()
        self._rest()
        if not self._braking:
            self._stand()

    def _stand(self) -> None:
        self._goal = np.clip(self._measured(), self._lower, self._upper)

    def wait(self, duration: float) -> Readings:
        """See Driver."""
        if not 0.0 <= duration < np.inf:
            raise InputError(f"wait takes a finite time of at least 0 s; got {duration}")
        intervals = max(1, int(np.ceil(duration / (self._every * self._dt) - 1e-9)))
        left, silence = intervals * self._every, round(self.limits.watchdog / self._dt)
        states, felt, torques, true = [], [], [], []
        while left:
            if silence == 0 and (self._ramp or self._reacts):
                self.stop()
                self._fault = f"watchdog: no call for {self.limits.watchdog:g} s"
            T = min(left, silence or left, self._chunk())
            ctrl = self._plan(T)
            state, sensors = self._run(ctrl)
            wrench = -sensors[:, self._wrench].reshape(T, -1, 6)
            late = np.concatenate([self._tail, wrench]) if self._late else wrench
            reading = self._errors.wrench(state[:, 0], late[:T])
            done = self._react(state, reading, sensors[:, self._torque])
            self._state = state[done - 1].copy()
            if self._late:
                self._tail = late[done : done + self._late]
            if done < T:
                self._warm = np.zeros_like(self._warm)
            self._last = np.concatenate([self._last, reading[:done]])[-self._zeroing :]
            states.append(state[:done])
            felt.append(reading[:done])
            torques.append(sensors[:done, self._torque])
            true.append(wrench[:done])
            left -= done
            silence = max(0, silence - done)
        return self._readings(*map(np.concatenate, (states, felt, torques, true)))

    # ------------------------------------------------------------ the fast loop

    @property
    def _reacts(self) -> bool:
        """True while a finger closes, holds or presses."""
        return any(self._mode) or self._asked is not None

    def _chunk(self) -> int:
        if self._braking:
            return self._braking
        return math.ceil((REACTING if self._reacts else MOVING) / self._dt)

    def _plan(self, T: int) -> np.ndarray:
        """Targets of the servos (T, nu) over the next steps; moves the goal along."""
        after = np.arange(1, T + 1)
        goal = np.repeat(self._goal[None], T, axis=0)
        speed = np.zeros_like(goal)
        if self._ramp is not None:
            start, end, step, steps = self._ramp
            s = np.minimum((step + after) / steps, 1.0)[:, None]
            goal = start + (end - start) * (s * s * s * (10.0 + s * (6.0 * s - 15.0)))
            speed = (end - start) * (30.0 * (s * (1.0 - s)) ** 2 / (steps * self._dt))
            self._ramp = (start, end, step + T, steps) if step + T < steps else None
        if self._braking:
            speed = self._going * np.maximum(1.0 - after / self._braking, 0.0)[:, None]
            goal += speed.cumsum(axis=0) * self._dt
        closing = [i for i, mode in enumerate(self._mode) if mode == CLOSING]
        if closing:
            W = self._closing[closing]
            now, wanted = np.array(self._now)[closing], np.array(self._speed)[closing]
            gain = (CLOSING_ACCELERATION * self._dt * after)[:, None]
            v = now + np.minimum(np.maximum(wanted - now, -gain), gain)
            speed += v @ W
            ahead = goal[0] + (v.cumsum(axis=0) * self._dt) @ W
            speed[(ahead < self._lower) | (ahead > self._upper)] = 0.0  # at the end of its range
            goal = np.where(W.any(axis=0), np.clip(ahead, self._lower, self._upper), goal)
        if HOLDING in self._mode:
            felt = self._middle() - self._zero
            q, share = self._measured(), after / T
            for i, mode in enumerate(self._mode):
                if mode == HOLDING:
                    goal += share[:, None] * self._correction(i, math.hypot(*felt[i]), q, T)
        if self._asked is not None:
            j = self._fingers
            goal[:, j] = self._goal[j] + (after / T)[:, None] * self._pressing(T)
            speed[:, j] = 0.0
        ctrl = np.zeros((T, self.model.nu))
        told = goal - self._errors.encoder_offset
        slack = self._errors.about.backlash / 2.0
        if slack:
            play = self._play
            for t in range(T):
                play = np.clip(play, told[t] - slack, told[t] + slack)
                told[t] = play
        for i in self._errors.stalled(float(self._state[0])):
            j = self._closing[i] != 0.0
            told[:, j], speed[:, j] = self._play[j], 0.0
        ctrl[:, self._servo] = (told + self._lag * speed)[:, self._driven]
        self._planned = goal, speed, told
        return ctrl

    def _correction(self, i: int, felt: float, q: np.ndarray, T: int) -> np.ndarray:
        """How far (n,) [rad] holding moves finger i's target over the next T steps."""
        give, way = self._give[i], self._closing[i]
        change = _within(self._force[i] - self._aim[i], FORCE_RATE * T * self._dt)
        self._aim[i] += change
        wanted = give * (0.5 * change + FORCE_GAIN * (self._aim[i] - felt))
        goal = self._goal + way * _within(wanted, HOLDING_SPEED * T * self._dt)
        # However little a broken sensor says, the servos' own error bounds the force.
        most = q + way * (LEAD * give * self._force[i] + STALL)
        goal = np.where(way > 0.0, np.minimum(goal, most), np.maximum(goal, most))
        return np.where(way != 0.0, np.clip(goal, self._lower, self._upper) - self._goal, 0.0)

    def _pressing(self, T: int) -> np.ndarray:
        """How far (f,) [rad] pressing moves the fingers' targets over the next T steps.

        In between the servos are springs: they hold what is pressed where torques alone let it go.
        """
        assert self._asked is not None
        j, most = self._fingers, PRESS_RATE * T * self._dt
        missing = self._asked - self._motors[j]
        missing[np.abs(missing) <= self._slack] = 0.0
        wanted = np.clip(FORCE_GAIN * missing, -most, most) / self._kp[j]
        goal = np.clip(self._goal[j] + wanted, self._lower[j], self._upper[j])
        return np.asarray(goal - self._goal[j])

    @property
    def _slack(self) -> float:
        """What pressed joints may be off what is asked of them [N·m]."""
        assert self._asked is not None
        return FOLLOWED * float(np.abs(self._asked).max(initial=0.0))

    def _run(self, ctrl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Simulate; states (T, ·) after each step, and sensors (T, ·) during it."""
        T = len(ctrl)
        states = np.empty((1, T, self._size))
        sensors = np.empty((1, T, self.model.nsensordata))
        self._rollout.rollout(
            [self.model],
            [self._data],
            self._state[None, : self._size],
            ctrl[None],
            skip_checks=True,
            nstep=T,
            initial_warmstart=self._warm[None],
            state=states,
            sensordata=sensors,
        )
        self._warm = self._data.qacc_warmstart.copy()
        self.simulated += T
        if len(self._standing) > 1:
            standing = np.broadcast_to(self._standing, (T, len(self._standing)))
            return np.concatenate([states[0], standing], axis=1), sensors[0]
        return states[0], sensors[0]

    def _react(self, state: np.ndarray, wrench: np.ndarray, motors: np.ndarray) -> int:
        """See what happened first in these steps, act on it; return how many steps stand."""
        T = len(state)
        goal, speed, told = self._planned
        first, what = T, None  # what happens at the end of step `first`, if anything
        force = wrench[:, :, :3]
        square = _squares(force)
        above = square > self._guard**2
        if above.any():
            over = _twice(above)
            if over.any():
                first = int(np.argmax(over.any(axis=1)))
                what = ("guard", int(np.argmax(over[first])))
        behind = goal - self._errors.encoder_offset - state[:, self._q]
        closing = [i for i, mode in enumerate(self._mode) if mode == CLOSING]
        if closing:
            change = _squares(force[:, closing] - self._zero[closing])
            touched = change > np.array(self._force)[closing] ** 2
            ahead = self._closing[closing]
            late = STALL + 0.5 * self._lag * np.abs(speed)
            slow = behind[:, None] * np.sign(ahead) > late[:, None]
            stuck = (slow & (ahead != 0.0)).any(axis=2)
            for kind, happens in (("touch", _twice(touched)), ("stall", stuck)):
                if happens[:first].any():
                    first = int(np.argmax(happens.any(axis=1)))
                    what = (kind, closing[int(np.argmax(happens[first]))])
        if not self._reacts and speed.any():
            dead = (wrench[1:] == wrench[:-1]).all(axis=2)
            for _ in range(SILENT - 2):
                dead = dead[1:] & dead[:-1]
            alone = dead.any(axis=1) & ~dead.all(axis=1)  # at the first of SILENT samples
            if alone[: max(0, first - SILENT + 1)].any():
                first = int(np.argmax(alone))
                what = ("silent", int(np.argmax(dead[first])))
                first += SILENT - 1
        beside = np.abs(behind)
        # What presses is beside its target, and bounded otherwise.
        holding = [mode == HOLDING for mode in self._mode]
        beside[:, self._closing[holding].any(axis=0)] = 0.0
        if self._asked is not None:
            beside[:, self._fingers] = 0.0
        if beside[:first].max(initial=0.0) > FOLLOWING:
            first = int(np.argmax((beside > FOLLOWING).any(axis=1)))
            what = ("held", int(beside[first].argmax()))
        done = min(first + 1, T)
        self._goal = goal[done - 1].copy()
        self._play = told[done - 1].copy()
        self._going = speed[done - 1].copy()
        if self._braking:
            self._braking = max(0, self._braking - done)
            if not self._braking:
                self._state = state[done - 1].copy()
                self._stand()
        for i in range(len(self._mode)):
            way = self._closing[i]
            self._now[i] = float(speed[done - 1] @ way / (way @ way)) if self._mode[i] else 0.0
        self._motors[self._driven] = motors[done - 1]
        if self._asked is not None and what is None:
            what = self._runaway(done)
        if what is None:
            return done
        kind, i = what
        self._state = state[done - 1].copy()
        if kind == "held":
            self.stop()
            held = f"something holds {self.robot.joints[i]}: it does not follow"
            self._fault = self._fault or held
        elif kind == "runaway":
            self.stop()
            meets = f"{self.robot.joints[i]} meets nothing that resists what it presses with"
            self._fault = self._fault or meets
        elif kind == "silent":
            name = self.robot.description.contact_points[i].name
            self.stop()
            self._fault = self._fault or f"the sensor of {name} does not answer"
        elif kind == "guard":
            name, most = self.robot.description.contact_points[i].name, self._guard[i]
            self.stop()
            self._fault = self._fault or f"contact force above {most:.2g} N at {name}"
        elif kind == "touch":
            self._begin_holding(i)
        else:
            self._mode[i] = IDLE
            self._now[i] = 0.0
            self._stalled[i] = True
            self._goal = np.where(self._closing[i] != 0.0, self._measured(), self._goal)
        return done

    def _runaway(self, steps: int) -> tuple[str, int] | None:
        """A joint that pressed without resistance for too long, `steps` more included."""
        assert self._asked is not None
        aim = RESISTING * np.abs(self._asked)
        firm = self._motors[self._fingers] * np.sign(self._asked) >= aim - self._slack
        self._giving = np.where(firm, 0.0, self._giving + steps * self._dt)
        over = self._giving - GIVING - aim / PRESS_RATE  # which is how long it takes to rise
        worst = int(over.argmax())
        return ("runaway", int(self._fingers[worst])) if over[worst] > 0.0 else None

    def _middle(self) -> np.ndarray:
        """Force (k, 3) [N] at the tips lately: the median, for a spike is nothing."""
        lately = self._last[-self._every :, :, :3]
        return np.sort(lately, axis=0)[len(lately) // 2]

    def _begin_holding(self, i: int) -> None:
        q, way = self._measured(), self._closing[i]
        J = self.robot.jacobian(np.clip(q, self._lower, self._upper))[3 * i : 3 * i + 3]
        # A force F along the tip's way does F |J w| of work by closing's unit; so do the servos.
        self._give[i] = float(np.linalg.norm(J @ way) / (self._kp @ (way * way)))
        self._mode[i], self._touched[i], self._now[i] = HOLDING, True, 0.0
        self._aim[i] = self._force[i]
        ahead = np.clip(q + way * (self._give[i] * self._force[i]), self._lower, self._upper)
        self._goal = np.where(way != 0.0, ahead, self._goal)

    def _measured(self) -> np.ndarray:
        return self._errors.joints(self._state[self._q])

    def _rest(self) -> None:
        self._mode = [IDLE] * len(self._mode)
        self._now = [0.0] * len(self._mode)
        self._touched, self._stalled = np.zeros_like(self._touched), np.zeros_like(self._stalled)
        self._guard = np.full(len(self._mode), GUARD * self.limits.force)

    def _readings(
        self, states: np.ndarray, felt: np.ndarray, torques: np.ndarray, true: np.ndarray
    ) -> Readings:
        velocity = states[:, self._v]
        q = self._errors.joints(states[:, self._q])
        outside = np.maximum(self.limits.lower - q.min(axis=0), q.max(axis=0) - self.limits.upper)
        speed = np.maximum(velocity.max(axis=0), -velocity.min(axis=0)) / self.limits.speed
        torque = np.maximum(torques.max(axis=0), -torques.min(axis=0))
        torque /= self.limits.torque[self._driven]
        force = math.sqrt(_squares(true[..., :3]).max())
        for name, value in zip(
            self.worst, (outside.max(), speed.max(), torque.max(), force), strict=True
        ):
            self.worst[name] = max(self.worst[name], float(value))
        at = slice(self._every - 1, None, self._every)
        motors = np.zeros_like(q[at])
        motors[:, self._driven] = torques[at]
        return Readings(
            time=states[at, 0],
            q=q[at],
            velocity=velocity[at],
            wrench=felt[at],
            touched=self._touched,
            stalled=self._stalled,
            fault=self._fault,
            torque=motors,
        )


def _within(value: float, most: float) -> float:
    """`value`, cut to ± most."""
    return max(-most, min(value, most))


def _squares(force: np.ndarray) -> np.ndarray:
    """|f|² (t, k) of forces (t, k, 3)."""
    return np.einsum("tia,tia->ti", force, force)


def _twice(above: np.ndarray) -> np.ndarray:
    """Where `above` (t, …) holds at a step and at the one before it: a spike is nothing."""
    both = above.copy()
    both[1:] &= above[:-1]
    both[:1] = False
    return both
