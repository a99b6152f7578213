"""Stacks by their letters: "fmk" is force ▷ moment ▷ kinematic."""

from __future__ import annotations

from hqp_grasp.errors import InputError
from hqp_grasp.tasks.align import AlignTask
from hqp_grasp.tasks.force import ForceTask
from hqp_grasp.tasks.kinematic import KinematicTask
from hqp_grasp.tasks.moment import MomentTask
from hqp_grasp.tasks.stack import Stack

LETTERS = "f (force), m (moment), k (kinematic), a (align)"


def stack_of(letters: str, kinematic_error: str = "angle") -> Stack:
    """Φ by its letters: "fmk" is force ▷ moment ▷ kinematic."""
    laws = {
        "f": ForceTask(),
        "m": MomentTask(),
        "k": KinematicTask(error=kinematic_error),
        "a": AlignTask(),
    }
    known = isinstance(letters, str) and letters != "" and set(letters) <= set(laws)
    if not known or len(set(letters)) < len(letters):
        raise InputError(
            f"unknown stack {letters!r}; write each law once, by its letter: {LETTERS}"
        )
    return Stack(tuple((laws[letter],) for letter in letters))
