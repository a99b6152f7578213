"""Control laws in strict order: `>>` composes as ▷ does in the paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import mink
import numpy as np

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Grasp
from hqp_grasp.level import Level
from hqp_grasp.limits import Limit, MinkLimit
from hqp_grasp.tasks import ContactTask, ForceTask, KinematicTask, MomentTask, Task

LETTERS = {"f": ForceTask, "m": MomentTask, "k": KinematicTask}


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
        full = self.priorities and all(isinstance(p, tuple) and p for p in self.priorities)
        if not full or not all(isinstance(t, Task) for p in self.priorities for t in p):
            raise InputError(
                "Stack.priorities must be tuples of control laws, none of them empty; "
                f"got {self.priorities!r}"
            )

    @classmethod
    def of(cls, task: Task) -> Stack:
        """A stack of one law."""
        return cls(((task,),))

    @classmethod
    def from_letters(cls, letters: str, kinematic_error: str = "angle") -> Stack:
        """Φ by its letters: "fmk" is force ▷ moment ▷ kinematic."""
        known = isinstance(letters, str)
        if (
            not known
            or not letters
            or len(set(letters)) < len(letters)
            or set(letters) - set(LETTERS)
        ):
            raise InputError(
                f"unknown stack {letters!r}; write each law once, by its letter: "
                "f (force), m (moment), k (kinematic)"
            )
        laws = {
            "f": ForceTask(),
            "m": MomentTask(),
            "k": KinematicTask(error=kinematic_error),
        }
        return cls(tuple((laws[letter],) for letter in letters))

    def __rshift__(self, other: Task | Stack) -> Stack:
        """`a >> b`: b subject to a."""
        below = other if isinstance(other, Stack) else Stack.of(_task(other))
        return replace(
            self,
            priorities=self.priorities + below.priorities,
            limits=self.limits + below.limits,
            hold_contacts=self.hold_contacts and below.hold_contacts,
        )

    def __add__(self, other: Task | Stack) -> Stack:
        """`a + b`: b at the priority of the last laws of a."""
        if isinstance(other, Stack):
            if len(other.priorities) != 1:
                raise InputError(
                    "`+` puts laws at one priority: add a task, or stacks of one level"
                )
            beside = other
        else:
            beside = Stack.of(_task(other))
        return replace(
            self,
            priorities=(*self.priorities[:-1], self.priorities[-1] + beside.priorities[0]),
            limits=self.limits + beside.limits,
            hold_contacts=self.hold_contacts and beside.hold_contacts,
        )

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
    def name(self) -> str:
        """The laws' names, "force ▷ moment ▷ kinematic"."""
        return " ▷ ".join(" + ".join(t.name for t in tasks) for tasks in self.priorities)

    def levels(self, grasp: Grasp) -> list[Level]:
        """The whole hierarchy: caps, ranges, clearances, contacts, laws."""
        return self.limit_levels(grasp) + self.law_levels(grasp)

    def limit_levels(self, grasp: Grasp) -> list[Level]:
        """One level for each rank of limits, caps first."""
        ranks = sorted({limit.rank for limit in self.limits})
        return [
            _joined(limit.level(grasp) for limit in self.limits if limit.rank == rank)
            for rank in ranks
        ]

    def law_levels(self, grasp: Grasp) -> list[Level]:
        """The equalities: no motion along the normals, then each priority's laws."""
        levels = [_joined([_level(ContactTask(), grasp)])] if self.hold_contacts else []
        for tasks in self.priorities:
            levels.append(_joined(_level(task, grasp) for task in tasks))
        return levels


def _task(value: object) -> Task:
    if not isinstance(value, Task):
        raise InputError(f"{value!r} is no control law: `>>` and `+` take tasks and stacks")
    return value


def _level(task: Task, grasp: Grasp) -> Level:
    A, b = task.rows(grasp)
    return Level.equal(A, b, task.name)


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
