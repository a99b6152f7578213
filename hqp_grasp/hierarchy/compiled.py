"""Says on the terminal, once, that the solver is being compiled: it would be silent for long."""

from __future__ import annotations

import sys
import threading
from typing import Protocol

from numba.core import event

from hqp_grasp import kernels

LINE = "hqp_grasp: compiling the solver, once (up to a minute); the result is kept"
ANEW = "hqp_grasp: compiling the solver (up to a minute)"  # it is not kept, and that has been said


class Turn(Protocol):
    """A semaphore, of threads or of processes: whoever takes its one turn speaks."""

    def acquire(self, blocking: bool, /) -> bool:
        """Take the turn; without `blocking`, False where it is taken."""
        ...


class _Notice(event.Listener):
    """LINE on stderr at the first compilation of a function of this package."""

    def __init__(self, turn: Turn) -> None:
        self.turn = turn

    def on_start(self, event: event.Event) -> None:
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("hqp_grasp.") and self.turn.acquire(False):
            # A progress bar may stand in this line: it is drawn anew below.
            line = ANEW if kernels.homeless else LINE
            print(f"\r{line:80}", file=sys.stderr, flush=True)

    def on_end(self, event: event.Event) -> None:
        """Nothing to say."""


_NOTICE = _Notice(threading.Semaphore(1))


def announce() -> None:
    """From now on this process says when it compiles; loading from numba's cache is no news."""
    event.register("numba:compile", _NOTICE)


def take_turns(turn: Turn) -> None:
    """Say it once in all processes that share `turn`."""
    _NOTICE.turn = turn
