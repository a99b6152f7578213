"""Compiled functions, kept for the next process wherever there is a folder to keep them in."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])
HOMELESS = (
    "hqp_grasp: neither the package's folder nor the user's cache can be written, so each process "
    "compiles the solver anew (up to a minute); set NUMBA_CACHE_DIR to a folder that can be "
    "written, and the result is kept there"
)
homeless: list[str] = []  # modules whose functions are not kept


def njit(**options: Any) -> Callable[[F], F]:
    """numba.njit, for which `cache=True` is a wish: without a folder it says how to have one."""

    def decorate(function: F) -> F:
        try:
            return numba.njit(**options)(function)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
        if not homeless and multiprocessing.parent_process() is None:
            print(HOMELESS, file=sys.stderr, flush=True)
        homeless.append(function.__module__)
        return numba.njit(**options | {"cache": False})(function)

    return decorate
