"""What can go wrong, each with the way out in its message."""

import math


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


class TrialError(HqpGraspError, RuntimeError):
    """A trial of a strict study, or every trial of a scenario, ended in an error."""

    def __init__(self, message: str, trial: int) -> None:
        super().__init__(message)
        self.trial = trial  # the number of the (first) one


class SingularTaskError(HqpGraspError, ArithmeticError):
    """A control law is undefined at this grasp, for a reason that the message names."""


class MissingExtraError(HqpGraspError, ImportError):
    """An optional package is not installed; the message gives the line that installs it."""


def number(name: str, value: object) -> float:
    """Return `value` as a float, else raise InputError."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be a number; got {value!r}") from error


def positive(name: str, value: object) -> float:
    """Return `value` as a finite float above zero, else raise InputError."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be a number above 0; got {value!r}") from error
    if not 0.0 < found < math.inf:
        raise InputError(f"{name} must be finite and above 0; got {found}")
    return found


def one_of(name: str, value: object, choices: object) -> str:
    """Return `value` if it is among `choices`, else raise InputError listing them."""
    valid = [str(c) for c in choices]  # type: ignore[attr-defined]
    if value not in valid:
        raise InputError(f"unknown {name} {value!r}; choose one of: {', '.join(valid)}")
    return str(value)
