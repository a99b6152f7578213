"""What can go wrong, each with the way out in its message."""

import math
import operator
import re
from collections.abc import Mapping
from importlib.metadata import requires
from numbers import Real

import numpy as np


class HqpGraspError(Exception):
    """Any error that hqp_grasp raises on purpose."""


class InputError(HqpGraspError, ValueError):
    """An argument is malformed: a wrong shape, a NaN, an unknown name, crossed bounds."""


class ModelError(HqpGraspError, ValueError):
    """A robot model lacks something its description names, or breaks a rule models must keep."""


class SolverError(HqpGraspError, RuntimeError):
    """No method found an answer that passes the optimality certificate."""


class ResultsError(HqpGraspError, OSError):
    """A results folder cannot be written, or belongs to another configuration."""


class WorkerError(HqpGraspError, RuntimeError):
    """The processes or the cluster of a study cannot do its work, or are gone."""


class ReachError(HqpGraspError, RuntimeError):
    """No starting posture touches the object: it is out of the hand's reach."""

    def __init__(self, message: str, reasons: Mapping[str, int] | None = None) -> None:
        super().__init__(message)
        self.reasons = dict(reasons or {})  # why, and of how many drawn postures


class TrialError(HqpGraspError, RuntimeError):
    """A trial of a strict study, or every trial of a scenario, ended in an error."""

    def __init__(self, message: str, trial: int) -> None:
        super().__init__(message)
        self.trial = trial  # the number of the (first) one


class SingularTaskError(HqpGraspError, ArithmeticError):
    """A control law is undefined at this grasp, for a reason that the message names."""


class MissingExtraError(HqpGraspError, ImportError):
    """An optional package is not installed; the message gives the line that installs it."""


def requirements() -> dict[str, dict[str, str]]:
    """What hqp_grasp needs, {extra: {package: requirement}}; the extra "" is what it always needs.

    A requirement is as pip reads it, "viser>=1.1.1".
    """
    found: dict[str, dict[str, str]] = {}
    for line in requires("hqp_grasp") or []:
        needed, _, marker = line.partition(";")
        extra = re.search(r"extra == ['\"](.+?)['\"]", marker)
        package = re.split(r"[^\w.-]", needed.strip(), maxsplit=1)[0]
        found.setdefault(extra[1] if extra else "", {})[package] = needed.strip()
    return found


def missing(extra: str, package: str, whose: str = "this") -> MissingExtraError:
    """The error for a package that an extra brings and that is not installed.

    Its line installs the extra's own requirements, so it works wherever hqp_grasp came from.
    """
    needed = " ".join(f"'{each}'" for each in requirements()[extra].values())
    return MissingExtraError(f"{whose} needs {package}: pip install {needed}")


def number(name: str, value: object) -> float:
    """Return `value` as a float, else raise InputError: numbers of numpy are some, "1" is none."""
    return _number(name, value, "a number")


def _number(name: str, value: object, wanted: str) -> float:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if not isinstance(value, Real) or isinstance(value, bool):
        raise InputError(f"{name} must be {wanted}; got {value!r}")
    return float(value)


def finite(name: str, value: object) -> float:
    """Return `value` as a finite float, else raise InputError."""
    found = number(name, value)
    if not math.isfinite(found):
        raise InputError(f"{name} must be finite; got {found}")
    return found


def positive(name: str, value: object) -> float:
    """Return `value` as a finite float above zero, else raise InputError."""
    found = _number(name, value, "a number above 0")
    if not 0.0 < found < math.inf:
        raise InputError(f"{name} must be finite and above 0; got {found}")
    return found


def not_negative(name: str, value: object) -> float:
    """Return `value` as a finite float of zero or above, else raise InputError."""
    found = _number(name, value, "a number of at least 0")
    if not 0.0 <= found < math.inf:
        raise InputError(f"{name} must be finite and at least 0; got {found}")
    return found


def whole(name: str, value: object, least: int) -> int:
    """Return `value` as an int of at least `least`, else raise InputError: 2.0 and "2" are none."""
    try:
        flag = isinstance(value, bool | np.bool_)
        found = None if flag else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        found = None
    if found is None:
        raise InputError(f"{name} must be a whole number; got {value!r}")
    if found < least:
        raise InputError(f"{name} must be at least {least}; got {found}")
    return found


def flag(name: str, value: object) -> bool:
    """Return `value` as a bool, else raise InputError: "no" would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} must be True or False; got {value!r}")
    return bool(value)


def instance(name: str, value: object, kind: type) -> None:
    """Raise InputError unless `value` is of this class."""
    if not isinstance(value, kind):
        raise InputError(f"{name} must be a {kind.__name__}; got {value!r}")


def one_of(name: str, value: object, choices: object) -> str:
    """Return `value` if it is among `choices`, else raise InputError listing them."""
    valid = [str(c) for c in choices]  # type: ignore[attr-defined]
    if not isinstance(value, str) or value not in valid:
        raise InputError(f"unknown {name} {value!r}; choose one of: {', '.join(valid)}")
    return str(value)
