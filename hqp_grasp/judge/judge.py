"""Judging a grasp: squeeze, lift, and pull at the object until it slips."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from hqp_grasp.control.forces import Grip, equal_normal, equal_torque, normal_null_space
from hqp_grasp.control.reach import carried
from hqp_grasp.errors import InputError, one_of, positive
from hqp_grasp.grasp import Grasp
from hqp_grasp.judge.bench import Bench
from hqp_grasp.world.physics import Physics
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

PROTOCOLS = ("pulls", "dexgraspbench")
AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
TORQUE_RATE = 2.0  # [N·m/s] by which the fingers' torques grow
CYCLE = 0.05  # [s] between looks at what is felt
SETTLING = 0.3  # [s] of squeezing after the torques have stopped growing
LIFTING = 0.08  # [m/s] of the palm
HOLDING = 1.0  # [s] held, once lifted
RISEN = 0.5  # share of the palm's way that a lifted object has risen by: it may slip, not stay
WATCHED = 0.5  # [s] of a pull between looks whether the object has slipped
GRAVITY = 10.0  # [m/s²] of DexGraspBench's pulls
DURATION = 2.0  # [s] of each of them
THROWN, TUMBLED = 0.05, np.radians(15.0)  # [m], [rad] beyond which they have failed

# Joint torques (n,) [N·m] for a grasp as it is felt; None: those of before.
Law = Callable[[Robot, Grasp], np.ndarray | None]
SIMPLE = {
    "equal-torque": equal_torque,
    "equal-normal": equal_normal,
    "null-space": normal_null_space,
}
SQUEEZES = ("hierarchy", *SIMPLE)


@dataclass(frozen=True)
class Judged:
    """How a grasp held."""

    lifted: bool
    height: float  # [m] the object rose by
    sum_normal: float  # [N] of all contacts' normal forces, before the pulls
    pulls: dict[str, float] = field(default_factory=dict)  # [N] at which it slipped, by axis
    twists: dict[str, float] = field(default_factory=dict)  # [N·m]
    passed: bool = False  # lifted; by DexGraspBench's protocol: held against all six pulls
    reason: str = ""  # why it is not

    @property
    def weakest_axis(self) -> float:
        """The least force [N] that made it slip; 0 where it was not lifted."""
        return min(self.pulls.values(), default=0.0)

    @property
    def weakest_twist(self) -> float:
        """The least torque [N·m] that did."""
        return min(self.twists.values(), default=0.0)


@dataclass(frozen=True)
class Judge:
    """Frees the object, squeezes it, lifts it by the arm, and pulls at it until it slips.

    `squeeze` is how the fingers press: "hierarchy" is `Grip` by its laws; "equal-torque",
    "equal-normal" and "null-space" (of the grasp map, along the normals) are simpler. All press
    with k times `force`, and the hierarchy with more where the load asks for it. Or it is a
    function of the robot and the grasp as it is felt. It is asked again every CYCLE until the
    object is lifted, and then no more: the grip does not react to the pulls. In between the servos
    stay where they were told, so fingers yield like springs.

    protocol="pulls": the object stands on a pedestal, is lifted by `lift`, and pulled at with
    forces and torques along the world's axes, one after the other from the same state, growing
    until it has moved by `slip` or turned by `turn` in the palm's frame. A hand without an arm has
    the pedestal taken away instead. protocol="dexgraspbench": once squeezed, support and gravity
    go, and a force of 10 m/s² times the mass acts for 2 s along each axis; it passes if the object
    never moved by 5 cm or turned by 15° (DexGraspBench; Chen, Ke and Wang, "BODex", 2024).

    The judge knows the object as it is. It is deterministic. Raises InputError, before anything
    moves, for a grasp that is not of the scene's robot, or that has a link in the object, and
    ModelError for a robot whose joints have no servos with force limits.
    """

    scene: Scene
    squeeze: str | Law = "hierarchy"
    force: float = 5.0  # [N] mean normal force of a contact
    mass: float = 0.1  # [kg]
    friction: float = 0.6
    believed: float = 0.5  # friction that the hierarchy counts on
    protocol: str = "pulls"
    lift: float = 0.1  # [m]
    slip: float = 0.01  # [m]
    turn: float = float(np.radians(15.0))  # [rad]
    most_force: float = 20.0  # [N]
    most_torque: float = 1.0  # [N·m]
    rate: float = 5.0  # [N/s] by which a pull grows
    twist_rate: float = 0.25  # [N·m/s]
    timestep: float = 0.004  # [s]

    def __post_init__(self) -> None:
        one_of("protocol", self.protocol, PROTOCOLS)
        for at in fields(self):
            if at.type == "float":
                object.__setattr__(
                    self, at.name, positive(f"Judge.{at.name}", getattr(self, at.name))
                )
        if not isinstance(self.scene, Scene):
            raise InputError(f"Judge.scene must be a Scene; got {self.scene!r}")
        if not callable(self.squeeze):
            one_of("squeeze", self.squeeze, SQUEEZES)

    def within(self, scene: Scene) -> Judge:
        """The same judge in another scene."""
        return replace(self, scene=scene)

    def judge(self, grasp: Grasp) -> Judged:
        """Test one grasp, from the posture in which it was felt."""
        robot = self.scene.articulated
        if not isinstance(grasp, Grasp) or grasp.n != robot.n:
            raise InputError(f"a judge of {robot} needs a grasp of its joints; got {grasp!r:.60}")
        physics = Physics(
            support="pedestal", mass=self.mass, friction=self.friction, timestep=self.timestep
        )
        bench = Bench(self.scene, grasp, physics)
        hand = _Squeeze(bench, self._law(robot), grasp)
        hand.tighten()
        if self.protocol == "dexgraspbench":
            return self._dexgraspbench(bench)
        before = bench.height
        rise = 0.0
        if robot.arm:
            way = carried(robot, bench.told, np.array([0.0, 0.0, self.lift]))
            if way is None:
                total = float(bench.touching().normal_force.sum())
                return Judged(False, 0.0, total, reason="out of reach")
            hand.follow(way, self.lift / LIFTING / len(way))
            rise = self.lift
        else:
            bench.remove_support()
        hand.hold(HOLDING)
        height = bench.height - before
        held = height > rise - (1.0 - RISEN) * self.lift
        total = float(bench.touching().normal_force.sum())
        if not held or total == 0.0:
            return Judged(False, height, total, reason="dropped")
        state = bench.saved()
        pulls, twists = {}, {}
        for axis in AXES:
            pulls[axis] = self._pull(bench, state, _along(axis, 0), self.rate, self.most_force)
            twists[axis] = self._pull(
                bench, state, _along(axis, 3), self.twist_rate, self.most_torque
            )
        return Judged(True, height, total, pulls, twists, passed=True)

    def _law(self, robot: Robot) -> Law:
        if callable(self.squeeze):
            return self.squeeze
        if self.squeeze == "hierarchy":
            grip = Grip(robot, self.force, self.believed)
            return lambda robot, grasp: grip.solve(grasp).torque
        simple = SIMPLE[self.squeeze]
        return lambda robot, grasp: simple(robot, grasp, self.force * grasp.k)

    def _pull(
        self,
        bench: Bench,
        state: tuple[np.ndarray, np.ndarray],
        unit: np.ndarray,
        rate: float,
        most: float,
    ) -> float:
        """The load along `unit` (6,) at which the object slips, or `most` if it never does."""
        bench.restore(state)
        first, done, load = None, 0, 0.0
        while load < most:
            steps = round(WATCHED / self.timestep)
            loads = rate * self.timestep * np.arange(done, done + steps)
            poses = bench.run(bench.told, WATCHED, loads[:, None] * unit)
            first = poses[0] if first is None else first
            gone = _slipped(poses, first, self.slip, self.turn)
            if gone.any():
                return min(float(loads[int(gone.argmax())]), most)
            done, load = done + steps, float(loads[-1])
        return most

    def _dexgraspbench(self, bench: Bench) -> Judged:
        bench.remove_support()
        bench.remove_gravity()
        total = float(bench.touching().normal_force.sum())
        state = bench.saved()
        held = {}
        for axis in AXES:
            bench.restore(state)
            poses = bench.run(bench.told, DURATION, GRAVITY * self.mass * _along(axis, 0)[None])
            held[axis] = not _slipped(poses, poses[0], THROWN, TUMBLED).any()
        lost = [axis for axis, kept in held.items() if not kept]
        pulls = {axis: GRAVITY * self.mass * kept for axis, kept in held.items()}
        why = f"pulled away along {', '.join(lost)}" if lost else ""
        return Judged(False, 0.0, total, pulls, passed=not lost, reason=why)


class _Squeeze:
    """The fingers' torques, led to what the law asks for at a bounded rate."""

    def __init__(self, bench: Bench, law: Law, grasp: Grasp) -> None:
        self._bench, self._law, self._felt = bench, law, grasp
        robot = bench.robot
        self._presses = ~robot.idle & ~np.isin(np.arange(robot.n), robot.arm)
        self._torque = np.zeros(robot.n)

    def _wanted(self) -> np.ndarray:
        bench = self._bench
        self._felt = bench.grasp() or self._felt  # where a contact is lost, as it was before
        wanted = self._law(bench.robot, self._felt)
        if wanted is None:
            return self._torque
        return np.where(self._presses, np.clip(wanted, -bench.strength, bench.strength), 0.0)

    def cycle(self, told: np.ndarray, duration: float = CYCLE) -> bool:
        """Press on while the arm goes to `told` (n,) [rad]; whether the torques are there."""
        bench = self._bench
        missing = self._wanted() - self._torque
        most = TORQUE_RATE * duration
        self._torque = self._torque + np.clip(missing, -most, most)
        pressing = bench.q + self._torque / bench.kp
        bench.run(np.where(self._presses, pressing, told), duration)
        return bool(np.abs(missing).max() <= most)

    def tighten(self) -> None:
        """Squeeze until the torques are what the law asks for, and a little longer."""
        bench = self._bench
        longest = 2.0 * bench.strength[self._presses].max(initial=0.0) / TORQUE_RATE
        left = SETTLING
        for _ in range(round((longest + SETTLING) / CYCLE)):
            there = self.cycle(bench.told)
            left = left - CYCLE if there else SETTLING
            if left <= 0.0:
                break

    def follow(self, way: list[np.ndarray], each: float) -> None:
        """Press on while the arm passes these postures (n,) [rad], `each` [s] for one."""
        bench = self._bench
        count = max(1, round(each / CYCLE))
        for q in way:
            start = bench.told.copy()
            for i in range(1, count + 1):
                self.cycle(start + (q - start) * i / count, each / count)

    def hold(self, duration: float) -> None:
        """Press on, standing still."""
        for _ in range(round(duration / CYCLE)):
            self.cycle(self._bench.told)


def _along(axis: str, first: int) -> np.ndarray:
    unit = np.zeros(6)
    unit[first + "xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return unit


def _slipped(poses: np.ndarray, first: np.ndarray, far: float, wide: float) -> np.ndarray:
    """Where (T,) poses (T, 7) have moved by `far` [m] or turned by `wide` [rad] from the first."""
    moved = np.linalg.norm(poses[:, :3] - first[:3], axis=1)
    turned = 2.0 * np.arccos(np.minimum(np.abs(poses[:, 3:] @ first[3:]), 1.0))
    return np.asarray((moved > far) | (turned > wide))
