"""Files that are written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hqp_grasp.errors import HqpGraspError, ResultsError

PART = ".part"  # ending of a file that is being written, after the number of its process


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a file beside `path` that takes its place once it is written.

    Raises ResultsError where the disk does not take it, as when it is full; nothing is left then.
    """
    path = Path(path)
    part = path.with_name(f"{path.name}.{os.getpid()}{PART}")
    try:
        yield part
        part.replace(path)
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError) and not isinstance(error, HqpGraspError):
            raise ResultsError(f"{path} cannot be written: {error.strerror or error}") from error
        raise


def digest(plain: object) -> bytes:
    """SHA-256 of what JSON can hold; the same for what JSON has held."""
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).digest()


def sweep(folder: Path) -> None:
    """Remove what processes left that died while they wrote."""
    for part in folder.glob(f"*{PART}"):
        number = part.name.removesuffix(PART).rpartition(".")[2]
        if not number.isdecimal() or not _is_alive(int(number)):
            part.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # another user's; none at all, but not ours to judge
        return True
    return True
