"""Work that tells on its process or kills it, where worker processes can import it."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from numba import njit


@dataclass(frozen=True)
class Square:
    """i², but the process of the numbers in `deadly` is killed; the first `times` times."""

    deadly: tuple[int, ...] = ()
    times: int | None = None
    marks: Path | None = None  # where deaths are counted, if they are

    def __call__(self, i):
        if i in self.deadly and self._is_due(i):
            os.kill(os.getpid(), signal.SIGKILL)
        return i * i

    def _is_due(self, i):
        if self.times is None:
            return True
        died = len(list(self.marks.glob(f"{i}_*")))
        if died < self.times:
            (self.marks / f"{i}_{died}").touch()
        return died < self.times


def compiles(i):
    """i, after a function of the package was compiled, as its solver is where no cache has it."""

    def double(x):
        return 2 * x

    double.__module__ = "hqp_grasp.made_up"
    return njit(double)(i) // 2


def raises(i):
    if i == 1:
        raise RuntimeError("not here")
    return i


@dataclass(frozen=True)
class Slow:
    """Work that counts how often it is done at once in this process."""

    now: ClassVar[int] = 0
    most: ClassVar[int] = 0

    def __call__(self, i):
        Slow.now += 1
        Slow.most = max(Slow.most, Slow.now)
        time.sleep(0.01)
        Slow.now -= 1
        return i
