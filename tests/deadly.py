"""Work that some processes do not survive, where worker processes can import it."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path


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


def raises(i):
    if i == 1:
        raise RuntimeError("not here")
    return i
