"""What to aim at: places where the laws are content, and the levels that take contacts there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.mechanics import tangents
from hqp_grasp.surface.surface import Surface, Way, spread, unit
from hqp_grasp.tasks import ContactSpaceTask, Priority, Stack, Task
from hqp_grasp.tasks.contact_space import in_contact_space
from hqp_grasp.world.clearance import link_balls
from hqp_grasp.world.robot import Robot

STEP = 1e-6  # [m] of the differences that slopes are; a contact that moves less has no direction
POSTURES = 5  # on the way, at which the hand must be able to be
CORRECTIONS = 2  # of Newton's method, from one to the next
AWAY = 2e-3  # [m] off its way a contact may stay: what landing makes good
DEEP = 5e-3  # [m] of a link in the object that is as bad as twice AWAY
INTO = 0.2  # [–] of a finger's closing that goes into the surface, or it slides past
DIRECTIONS = spread(300)  # in which links and the object are told apart


@dataclass(frozen=True, eq=False)
class Target:
    """A way over the surface for every contact of a grasp, as the laws of a stack see it."""

    grasp: Grasp
    stack: Stack
    surface: Surface
    way: Way

    @classmethod
    def each(cls, surface: Surface, stack: Stack, grasp: Grasp) -> list[Target]:
        """Targets that differ, the best first."""
        return [cls(grasp, stack, surface, way) for way in surface.ways(grasp)]

    def imagined(self, share: float, only: int | None = None) -> Grasp:
        """The grasp after a share of the way, felt where the surface says; the joints stay.

        With `only` that contact alone has moved.
        """
        return self._moved(*self.way.at(share), range(self.grasp.k) if only is None else [only])

    def _moved(self, centers: np.ndarray, normals: np.ndarray, which: Iterable[int]) -> Grasp:
        """The grasp with these contacts at these centres (k, 3) [m] and normals (k, 3)."""
        contacts = list(self.grasp.contacts)
        for i in which:
            x = centers[i] - contacts[i].tip_radius * normals[i]
            contacts[i] = replace(contacts[i], position=x, normal=normals[i], point=None)
        return replace(self.grasp, contacts=tuple(contacts))

    def obstacle(self, robot: Robot, gain: float) -> float:
        """How badly something keeps the hand from the way: 0 where nothing does.

        On the way it is what contacts miss of it, and links that reach into the object, as far as
        it is believed to; at its end fingers that close along the surface rather than into it.
        """
        links, away, deep = link_balls(robot), 0.0, 0.0
        bounds = DIRECTIONS, self.surface.reach(DIRECTIONS)
        for q, missing in self._postures(robot, gain):
            away, deep = max(away, missing), max(deep, links.depth(q, *bounds))
        if not np.isfinite(away):
            return np.inf
        J = robot.carried(self.grasp, q)[1].reshape(self.grasp.k, 3, -1)
        closing = np.einsum("kan,kn->ka", J, robot.closing_at(q))
        into = -(closing * self.way.at(gain)[1]).sum(axis=1) / np.linalg.norm(closing, axis=1)
        excess = away / AWAY - 1.0, deep / DEEP, 1.0 - float(into.min()) / INTO
        return sum(max(part, 0.0) for part in excess)

    def _postures(self, robot: Robot, gain: float) -> Iterator[tuple[np.ndarray, float]]:
        """Joints (n,) [rad] along the way within limits, and how far [m] a contact stays off it."""
        limits = [v for v in self.stack.limits if v.priority is not Priority.CAP]
        hqp, q = HQP("active-set"), self.grasp.q
        offset = robot.carried(self.grasp, q)[0] - self.grasp.centers.ravel()
        still = Level.equal(np.eye(len(q)), np.zeros(len(q)))
        for share in gain * np.arange(1, POSTURES + 1) / POSTURES:
            goal = self.way.at(share)[0].ravel() + offset
            for _ in range(CORRECTIONS):
                x, J = robot.carried(self.grasp, q)
                there = replace(self.grasp, q=q, jacobian=J, rolling=None, hessian=None)
                levels = [limit.level(there) for limit in limits]
                solution = hqp.solve([*levels, Level.equal(J, goal - x), still])
                if not solution.certified:
                    yield q, np.inf
                    return
                q = q + solution.x
            off = (robot.carried(self.grasp, q)[0] - goal).reshape(-1, 3)
            yield q, float(np.linalg.norm(off, axis=1).max())

    def levels(self, share: float, gain: float = 1.0) -> list[Level]:
        """The laws' levels for a share of the way, down to the last law of contact space, and the
        way itself.
        """
        grasp, stack = self.grasp, self.stack
        motion = self.way.at(share)[0] - grasp.centers
        levels: list[Level] = []
        if stack.hold_contacts:
            rest = (grasp.normals * motion).sum(axis=1)
            levels.append(Level.equal(grasp.normal_jacobian(), rest, "contact"))
        for tasks in stack.priorities[: self._last + 1]:
            rows = []
            for task in tasks:
                if in_contact_space(task):
                    rows.append(self._secant(task, motion, share, gain))
                else:
                    A, b = task.rows(grasp)
                    rows.append((A, share / gain * b))
            levels.append(_joined(tasks, rows))
        return [*levels, Level.equal(grasp.jacobian, motion.ravel(), "way")]

    def below(self, damping: float) -> list[Level]:
        """The levels of the laws below, which ask for `damping` of theirs."""
        levels = []
        for tasks in self.stack.priorities[self._last + 1 :]:
            rows = [(A, damping * b) for A, b in (task.rows(self.grasp) for task in tasks)]
            levels.append(_joined(tasks, rows))
        return levels

    @property
    def _last(self) -> int:
        """The last priority with a law of contact space."""
        there = [any(map(in_contact_space, tasks)) for tasks in self.stack.priorities]
        return len(there) - 1 - there[::-1].index(True)

    def _secant(
        self, task: ContactSpaceTask, motion: np.ndarray, share: float, gain: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows (A, b) whose steps are exact for the predicted motion d_i of the contacts.

        ∂e/∂c_i has two directions along the surface: for d_i the secant, what contact i adds to the
        error by all of its motion, and across it the slope, as the surface turns. What contacts add
        together is shared by those that move. The law asks for what the way makes of its error, and
        for a share of what is left of it at the end, unless it is content with that.
        """
        grasp, e = self.grasp, task.error(self.grasp)
        first = tangents(grasp.normals)[:, 0]
        far = np.linalg.norm(motion, axis=1)
        moves = (far > STEP)[:, None]
        along = np.where(moves, motion / np.maximum(far, STEP)[:, None], first)
        across = unit(np.cross(grasp.normals, along))
        change = np.array([task.error(self.imagined(share, i)) - e for i in range(grasp.k)])
        whole = task.error(self.imagined(share)) - e
        change[moves[:, 0]] += (whole - change.sum(axis=0)) / max(int(moves.sum()), 1)
        slope = np.where(moves, change / np.maximum(far, STEP)[:, None], self._slopes(task, along))
        blocks = slope[:, :, None] * along[:, None, :]
        blocks = blocks + self._slopes(task, across)[:, :, None] * across[:, None, :]
        A = blocks.swapaxes(0, 1).reshape(len(e), -1) @ grasp.jacobian
        left = task.error(self.imagined(gain))
        goal = task.goal_at(self.imagined(gain))
        content = goal is not None and left @ left <= goal
        b = whole if content else whole - (share / gain) * task.gain * left
        return task.weight * A, task.weight * b

    def _slopes(self, task: ContactSpaceTask, d: np.ndarray) -> np.ndarray:
        """∂e/∂c_i d_i (k, r) for unit motions d (k, 3) of each contact's centre by itself."""
        turned = (self._turn @ d[:, :, None])[:, :, 0]
        sides = []
        for h in (STEP, -STEP):
            c, n = self.grasp.centers + h * d, unit(self.grasp.normals + h * turned)
            moved = [self._moved(c, n, [i]) for i in range(self.grasp.k)]
            sides.append(np.array([task.error(grasp) for grasp in moved]))
        return (sides[0] - sides[1]) / (2.0 * STEP)

    @cached_property
    def _turn(self) -> np.ndarray:
        return self.surface.turn(self.grasp)


def nearest_free(targets: Sequence[Target], robot: Robot, gain: float) -> Target:
    """The first from which nothing keeps the hand, or the one from which the least does."""
    obstacles = []
    for target in targets:
        obstacles.append(target.obstacle(robot, gain))
        if obstacles[-1] == 0.0:
            break
    return targets[int(np.argmin(obstacles))]


def _joined(tasks: Sequence[Task], rows: list[tuple[np.ndarray, np.ndarray]]) -> Level:
    A, b = (np.concatenate(v) for v in zip(*rows, strict=True))
    return Level.equal(A, b, " + ".join(task.name for task in tasks))
