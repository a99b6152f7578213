"""A control law, and how laws compose in strict order: `>>` is the paper's ▷."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import ClassVar

import mink
import mujoco
import numpy as np
from mink.tasks import BaseTask

from hqp_grasp.errors import InputError, flag, instance, positive
from hqp_grasp.grasp import Grasp
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks import mink_rows
from hqp_grasp.tasks.limit import Limit, MinkLimit


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """A control law: an error that should vanish, and how it changes with the joints.

    A new law is a subclass with two methods, `error` and `jacobian`. It reads a Grasp and
    nothing else, and is complete once built.
    """

    gain: float = 1.0  # [–] share of the error to remove in one probe; 1 is a full Newton step
    weight: float = 1.0  # [–] scales the rows; matters only beside other tasks on one level
    goal: ClassVar[float | None] = None  # eᵀe with which the law is content; None: with 0 only

    def __post_init__(self) -> None:
        for setting in ("gain", "weight"):
            value = positive(f"{type(self).__name__}.{setting}", getattr(self, setting))
            object.__setattr__(self, setting, value)

    @property
    def name(self) -> str:
        """The law's short name: "force" for ForceTask."""
        return type(self).__name__.removesuffix("Task").lower()

    @abstractmethod
    def error(self, grasp: Grasp) -> np.ndarray:
        """The quantity that should vanish, (r,)."""

    @abstractmethod
    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂error/∂q (r, n) [unit of the error / rad]."""

    @property
    def unit(self) -> str:
        """Of the error; "rad" where it compares with joint motions as it is."""
        return ""

    def goal_at(self, grasp: Grasp) -> float | None:
        """eᵀe with which the law is content at this grasp: `goal`, unless contacts change it."""
        return self.goal

    def floor(self, grasp: Grasp) -> float:
        """What noise of the contacts makes of eᵀe where it vanishes, on average."""
        return 0.0

    def damping(self, grasp: Grasp) -> float:
        """μ of μ‖Δq‖² over all joints, which holds the law's motion back [unit of A, squared]."""
        return 0.0

    def rows(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
        """The equality rows (A, b) asked of x = Δq over one probe: jacobian·x = −gain·error."""
        A = self.weight * np.asarray(self.jacobian(grasp), dtype=float)
        b = (-self.weight * self.gain) * np.asarray(self.error(grasp), dtype=float)
        return A, b

    def __rshift__(self, other: Law) -> Stack:
        """`a >> b`: b subject to a (the paper's a ▷ b)."""
        return Stack.of(self) >> other

    def __rrshift__(self, other: BaseTask) -> Stack:
        return Stack.of(other) >> self

    def __add__(self, other: Law) -> Stack:
        """`a + b`: both at the same priority."""
        return Stack.of(self) + other

    def __radd__(self, other: BaseTask) -> Stack:
        return Stack.of(other) + self


@dataclass(frozen=True, eq=False)
class MinkTask(Task):
    """A task of mink: its rows W Δq_full = e, carried over to the independent joints, W C x = e.

    Its cost, gain and damping are its own; `gain` and `weight` come on top of them.
    """

    task: BaseTask
    model: mujoco.MjModel | None = None  # that the task speaks of; None: the robot's
    name: str = ""  # in records; "": its class, and the frame it is of

    def __post_init__(self) -> None:
        super().__post_init__()
        instance("MinkTask.task", self.task, BaseTask)
        if self.model is not None:
            instance("MinkTask.model", self.model, mujoco.MjModel)
        if not isinstance(self.name, str):
            raise InputError(f"MinkTask.name must be a text; got {self.name!r}")
        if not self.name:
            object.__setattr__(self, "name", _name_of(self.task))

    def on(self, model: mujoco.MjModel) -> MinkTask:
        """The same task of this model, unless it has one; InputError where it cannot be."""
        model = self.model or model
        self._asked(mink.Configuration(model))
        return replace(self, model=model)

    def error(self, grasp: Grasp) -> np.ndarray:
        """The task's error (r,) [its own units], of the rows that have a cost."""
        return self._measured(grasp)[0]

    def jacobian(self, grasp: Grasp) -> np.ndarray:
        """∂error/∂q (r, n), by the independent joints."""
        return self._measured(grasp)[1] @ np.asarray(grasp.coupling)

    def rows(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
        """The rows (W C, e) of mink's objective ‖W Δq_full − e‖²."""
        W, e, _ = self._asked(self._configuration(grasp))
        return self.weight * W @ np.asarray(grasp.coupling), self.weight * self.gain * e

    def damping(self, grasp: Grasp) -> float:
        """mink's Levenberg–Marquardt μ."""
        return self.weight**2 * self._asked(self._configuration(grasp))[2]

    def _asked(self, configuration: mink.Configuration) -> tuple[np.ndarray, np.ndarray, float]:
        """W (r, N), e (r,) and μ of mink's objective."""
        with self._refusing():
            return mink_rows.rows(self.task, configuration)

    def _measured(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
        """Error (r,) and its Jacobian (r, N) over all joints."""
        configuration, task = self._configuration(grasp), self.task
        if not isinstance(task, mink.Task):
            W, e, _ = self._asked(configuration)
            return -e, W
        with self._refusing():
            e, J = task.compute_error(configuration), task.compute_jacobian(configuration)
        counts = np.broadcast_to(task.cost != 0.0, e.shape)
        return e[counts], J[counts]

    def _configuration(self, grasp: Grasp) -> mink.Configuration:
        model = self.model or grasp.model
        if not isinstance(model, mujoco.MjModel):
            raise InputError(
                f"the law {self.name!r} needs the robot's model, which this grasp does not tell: "
                "give MinkTask(task, robot.model)"
            )
        return mink_rows.configuration_of(model, grasp.q_full, f"the law {self.name!r}")

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        """What mink refuses, such as a frame that is not there, is refused by the law's name."""
        try:
            yield
        except mink.MinkError as error:
            raise InputError(f"the law {self.name!r}: {error}") from error


def _name_of(task: BaseTask) -> str:
    """Of a FrameTask of the site left_palm, "mink_frame_left_palm", so that no two are alike."""
    words = re.sub(r"(?<!^)(?=[A-Z])", "_", type(task).__name__.removesuffix("Task")).lower()
    parts = ["mink", words]
    parts += [str(getattr(task, of)) for of in ("frame_name", "root_name") if hasattr(task, of)]
    if isinstance(task, mink.FrameTask | mink.RelativeFrameTask):
        asks = {"position": task.cost[:3].any(), "orientation": task.cost[3:].any()}
        parts += [what for what, asked in asks.items() if asked and not all(asks.values())]
    return "_".join(parts)


@dataclass(frozen=True)
class Stack:
    """Laws by priority, the limits above them, and whether contacts stay on their surface.

    ForceTask() >> MomentTask() >> KinematicTask() is φ_f ▷ φ_m ▷ φ_k: left first. `a + b` puts
    two laws at one priority, `within` adds limits.
    """

    priorities: tuple[tuple[Task, ...], ...]
    limits: tuple[Limit, ...] = ()
    hold_contacts: bool = True  # ContactTask between the limits and the laws

    def __post_init__(self) -> None:
        object.__setattr__(self, "hold_contacts", flag("Stack.hold_contacts", self.hold_contacts))
        if not all(isinstance(limit, Limit) for limit in _tuple("limits", self.limits)):
            raise InputError(f"Stack.limits must be limits; got {self.limits!r}")
        priorities = _tuple("priorities", self.priorities)
        full = priorities and all(isinstance(p, tuple) and p for p in priorities)
        if not full or not all(isinstance(t, Task | BaseTask) for p in priorities for t in p):
            raise InputError(
                "Stack.priorities must be tuples of control laws, none of them empty; "
                f"got {self.priorities!r}"
            )
        taken = tuple(tuple(map(_task, tasks)) for tasks in priorities)
        object.__setattr__(self, "priorities", taken)
        names = [task.name for task in self.tasks]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(
                f"two laws of this stack are named {twice!r}, and records tell laws apart by name; "
                "make one a subclass with a `name` of its own, or a MinkTask(task, name=…)"
            )

    @classmethod
    def of(cls, laws: Law) -> Stack:
        """A stack of one law, which may be a task of mink, or the stack itself."""
        return laws if isinstance(laws, Stack) else cls(((_task(laws),),))

    def on(self, model: mujoco.MjModel) -> Stack:
        """The same laws, mink's tasks among them of this model, whatever grasps tell.

        Raises InputError where they speak of frames that it does not have, or have no target yet.
        """
        priorities = tuple(
            tuple(task.on(model) if isinstance(task, MinkTask) else task for task in tasks)
            for tasks in self.priorities
        )
        return replace(self, priorities=priorities)

    def __rshift__(self, other: Law) -> Stack:
        """`a >> b`: b subject to a."""
        below = Stack.of(other)
        return replace(
            self,
            priorities=self.priorities + below.priorities,
            limits=self.limits + below.limits,
            hold_contacts=self.hold_contacts and below.hold_contacts,
        )

    def __rrshift__(self, other: BaseTask) -> Stack:
        return Stack.of(other) >> self

    def __add__(self, other: Law) -> Stack:
        """`a + b`: b at the priority of the last laws of a."""
        beside = Stack.of(other)
        if len(beside.priorities) != 1:
            raise InputError("`+` puts laws at one priority: add a task, or stacks of one level")
        return replace(
            self,
            priorities=(*self.priorities[:-1], self.priorities[-1] + beside.priorities[0]),
            limits=self.limits + beside.limits,
            hold_contacts=self.hold_contacts and beside.hold_contacts,
        )

    def __radd__(self, other: BaseTask) -> Stack:
        return Stack.of(other) + self

    def within(self, *limits: Limit | mink.Limit) -> Stack:
        """The same laws below these limits too; mink's are taken as they are."""
        taken = []
        for limit in limits:
            if isinstance(limit, mink.Limit):
                limit = MinkLimit(limit)
            if not isinstance(limit, Limit):
                raise InputError(f"{limit!r} is no limit of hqp_grasp or mink")
            taken.append(limit)
        return replace(self, limits=(*self.limits, *taken))

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All laws, the most important first."""
        return tuple(task for tasks in self.priorities for task in tasks)

    def errors(self, grasp: Grasp) -> dict[str, np.ndarray]:
        """Each law's error (r,), by the law's name."""
        return {task.name: _error(task, grasp) for task in self.tasks}

    @property
    def name(self) -> str:
        """The laws' names, "force ▷ moment ▷ kinematic"."""
        return " ▷ ".join(map(_name, self.priorities))

    def levels(self, grasp: Grasp) -> list[Level]:
        """The whole hierarchy: caps, ranges, clearances, contacts, `damped` laws."""
        return self.damped(self.limit_levels(grasp) + self.law_levels(grasp), grasp)

    def damped(self, levels: list[Level], grasp: Grasp, hqp: HQP | None = None) -> list[Level]:
        """The levels, those of laws with a damping μ asking only for what is reached with it.

        That is the A x which minimises ‖A x − b‖² + μ‖C x‖² under the levels above, see
        `HQP.damped`; `hqp` solves, the compiled search unless given.
        """
        laws = {_name(tasks): tasks for tasks in self.priorities}
        dampings = [
            sum(task.damping(grasp) for task in laws.get(level.name, ())) for level in levels
        ]
        if not any(dampings):
            return levels
        return (hqp or HQP("active-set")).damped(levels, dampings, motion=grasp.coupling)

    def limit_levels(self, grasp: Grasp) -> list[Level]:
        """One level for each priority of limits, caps first."""
        priorities = sorted({limit.priority for limit in self.limits})
        return [
            _joined(limit.level(grasp) for limit in self.limits if limit.priority == priority)
            for priority in priorities
        ]

    def law_levels(self, grasp: Grasp) -> list[Level]:
        """The equalities: no motion along the normals, then each priority's laws."""
        levels = []
        if self.hold_contacts:
            levels.append(Level.equal(grasp.normal_jacobian(), np.zeros(grasp.k), "contact"))
        for tasks in self.priorities:
            levels.append(_joined(_level(task, grasp) for task in tasks))
        return levels


def _tuple(name: str, value: object) -> tuple:
    if not isinstance(value, tuple):
        raise InputError(f"Stack.{name} must be a tuple; got {value!r}")
    return value


def _name(tasks: Iterable[Task]) -> str:
    """Of the level that these laws share."""
    return " + ".join(task.name for task in tasks)


def _task(value: object) -> Task:
    if isinstance(value, BaseTask):
        return MinkTask(value)
    if not isinstance(value, Task):
        raise InputError(
            f"{value!r} is no control law: give a task, of mink too, or a stack of them"
        )
    return value


def _error(task: Task, grasp: Grasp) -> np.ndarray:
    with _named(task):
        error = np.asarray(task.error(grasp), dtype=float)
    if error.ndim != 1:
        raise InputError(f"the law {task.name!r}: error must have shape (r,); got {error.shape}")
    return error


def _level(task: Task, grasp: Grasp) -> Level:
    with _named(task):
        A, b = map(np.asarray, task.rows(grasp))
    if b.ndim != 1 or A.shape != (len(b), grasp.n):
        rows = len(b) if b.ndim == 1 else "r"
        raise InputError(
            f"the law {task.name!r}: error must have shape ({rows},) and jacobian "
            f"({rows}, {grasp.n}); got {b.shape} and {A.shape}"
        )
    return Level.equal(A, b, task.name)


@contextmanager
def _named(task: Task) -> Iterator[None]:
    """What a law raises says which law it was."""
    try:
        yield
    except Exception as error:
        error.add_note(f"raised by the law {task.name!r} ({type(task).__qualname__})")
        raise


def _joined(levels: Iterable[Level]) -> Level:
    parts: Sequence[Level] = list(levels)
    if len(parts) == 1:
        return parts[0]
    return Level(
        np.concatenate([p.A for p in parts]),
        np.concatenate([p.lower for p in parts]),
        np.concatenate([p.upper for p in parts]),
        " + ".join(p.name for p in parts),
    )


Law = Task | BaseTask | Stack
