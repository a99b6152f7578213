"""What decides the figures of a study, written down so that two runs can be compared."""

from __future__ import annotations

import ast
import copyreg
import hashlib
import importlib.util
import inspect
import math
import platform
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from types import BuiltinFunctionType, FunctionType

import llvmlite.binding
import mink
import mujoco
import numpy as np
from mink.tasks import BaseTask

from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

VERSIONS = ("numpy", "scipy", "numba", "mujoco", "mink", "proxsuite", "daqp", "qpsolvers")
PACKAGE = Path(__file__).parents[1]
STDLIB = Path(sysconfig.get_path("stdlib"))


class Fingerprint:
    """Everything that decides `value`, and what of it could not be had.

    `parts` is what JSON holds of it: numbers, arrays, compiled models and the fields of every
    object, in full. A class or function of the user's counts by the file that defines it and the
    user's files that this one imports, hqp_grasp by all of its source, libraries by their version.
    `unknown` names classes and functions whose source cannot be read again: those made
    interactively, by exec, inside a function, or as a lambda.
    """

    def __init__(self, value: object) -> None:
        self.unknown: list[str] = []
        self._sources: dict[str, str] = {}
        self.parts: dict[str, object] = {
            "trial": self._describe(value, "trial", ()),
            "source": self._sources,
            "hqp_grasp": _digest(*sorted(PACKAGE.rglob("*.py"))),
            "versions": {"python": "{}.{}".format(*sys.version_info)}
            | {package: version(package) for package in VERSIONS},
        }

    def _describe(self, value: object, at: str, above: tuple[int, ...]) -> object:
        """`value`, found at `at`, as JSON can hold it; `above` are the ids of what contains it."""
        if value is None or isinstance(value, bool | str):
            return value
        if isinstance(value, Enum):
            return f"{type(value).__name__}.{value.name}"
        if isinstance(value, int | np.integer | np.bool_):
            return int(value)
        if isinstance(value, float | np.floating):
            return float(value) if math.isfinite(value) else repr(float(value))
        if isinstance(value, Path):
            return str(value)
        if isinstance(value, np.ndarray) and value.dtype != object:
            return f"{value.dtype}{list(value.shape)} {_sha(value.tobytes())}"
        if isinstance(value, mujoco.MjModel):
            return f"model {_sha(_model_bytes(value))}"
        if isinstance(value, type | FunctionType | BuiltinFunctionType):
            self._note_source(value, at)
            return f"{value.__module__}.{value.__qualname__}"
        if id(value) in above:
            return "itself"
        above = (*above, id(value))
        if isinstance(value, Mapping):
            return {str(k): self._describe(v, f"{at}[{k!r}]", above) for k, v in value.items()}
        if isinstance(value, AbstractSet):
            return sorted((self._describe(v, at, above) for v in value), key=repr)
        if isinstance(value, tuple | list | np.ndarray):
            return [self._describe(v, f"{at}[{i}]", above) for i, v in enumerate(value)]
        kind = type(value)
        self._note_source(kind, at)
        described: dict[str, object] = {"class": f"{kind.__module__}.{kind.__qualname__}"}
        for name, held in self._held(value, at).items():
            described[name] = self._describe(held, f"{at}.{name}", above)
        return described

    def _held(self, value: object, at: str) -> dict[str, object]:
        """What an object is made of."""
        if isinstance(value, Robot):
            # The description's files are compiled into the model, wherever they stand.
            about = {k: v for k, v in vars(value.description).items() if k != "files"}
            return about | {"model": value.model}
        if isinstance(value, Scene):
            return {f.name: getattr(value, f.name) for f in fields(value)} | {
                "robot": value.articulated
            }
        if isinstance(value, mink.Limit | BaseTask) and _owner(type(value)) == "mink":
            # What mink keeps in private is derived, or scratch memory.
            return {k: v for k, v in vars(value).items() if not k.startswith("_")}
        if is_dataclass(value):
            made = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
            known = {f.name for f in fields(value)}
            for cls in inspect.getmro(type(value)):
                known |= {k for k, v in vars(cls).items() if isinstance(v, cached_property)}
            return made | {
                k: v for k, v in getattr(value, "__dict__", {}).items() if k not in known
            }
        try:
            made_by = value.__reduce_ex__(4)
        except TypeError:
            self.unknown.append(f"{at}: a {type(value).__qualname__} cannot be read")
            return {}
        plain = made_by[:2] == (copyreg.__newobj__, (type(value),))  # type: ignore[attr-defined]
        state = made_by[2] or {} if plain and not any(made_by[3:]) else None
        return state if isinstance(state, dict) else {"made by": made_by}

    def _note_source(self, thing: type | FunctionType | BuiltinFunctionType, at: str) -> None:
        """Take down the files that define a class and its bases, or a function."""
        parts = list(thing.__mro__) if isinstance(thing, type) else [thing]
        for part in parts:
            owner = _owner(part)
            if owner == "hqp_grasp" or owner in VERSIONS:
                continue
            if owner in sys.stdlib_module_names and _found_by_name(part):
                continue
            if "<" in part.__qualname__:
                why = "is a lambda or made inside a function: what it refers to cannot be read"
            else:
                try:
                    inspect.getsource(part)
                    path = Path(str(inspect.getsourcefile(part)))
                    for name, file in _with_imports(part.__module__, path).items():
                        self._sources[name] = _digest(file)
                    continue
                except (OSError, TypeError):
                    why = "has no source that can be read"
            reason = f"{part.__qualname__} ({at}) {why}"
            if reason not in self.unknown:
                self.unknown.append(reason)


@cache
def cpu_kind() -> str:
    """The kind of this machine's processor, as the compiler of the solver names it."""
    return f"{platform.machine()} {llvmlite.binding.get_host_cpu_name()}"


def differences(there: object, here: object, at: str = "") -> Iterator[str]:
    """Where two descriptions differ, in words."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in [*there, *(key for key in here if key not in there)]:
            path = f"{at}.{key}" if at else key
            yield from differences(there.get(key), here.get(key), path)
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        for i, (one, other) in enumerate(zip(there, here, strict=True)):
            yield from differences(one, other, f"{at}[{i}]")
    elif there != here:
        texts = repr(there), repr(here)
        if any("sha256" in text or len(text) > 40 for text in texts):
            yield f"{at} differs"
        else:
            yield f"{at} is {texts[0]} there, {texts[1]} here"


def _owner(thing: type | FunctionType | BuiltinFunctionType) -> str:
    return (thing.__module__ or "builtins").partition(".")[0]


def _found_by_name(thing: type | FunctionType | BuiltinFunctionType) -> bool:
    """False for what claims a module that does not have it, as dynamic classes do."""
    found: object = sys.modules.get(thing.__module__ or "builtins")
    for name in thing.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is thing


def _model_bytes(model: mujoco.MjModel) -> bytes:
    """All numbers and names of a model, but not the paths of the files that it was read from."""
    parts = [bytes(model.names)]
    for held in (model, model.opt, model.stat):
        for name in dir(held):
            value = getattr(held, name) if not name.startswith("_") else None
            numbers = isinstance(value, np.ndarray | int | float)
            if numbers and "path" not in name and name != "nbuffer":
                array = np.asarray(value)
                parts.append(f"{name} {array.dtype}{array.shape}".encode() + array.tobytes())
    return b"\n".join(parts)


def _sha(data: bytes) -> str:
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def _digest(*paths: Path) -> str:
    """One hash of these files."""
    return _sha("\n".join(f"{path.name} {_sha(path.read_bytes())}" for path in paths).encode())


def _with_imports(module: str, file: Path) -> dict[str, Path]:
    """The module's file, and the files of the user's own that it imports, directly or not."""
    found: dict[str, Path] = {}
    waiting = {module: file}
    while waiting:
        module, file = waiting.popitem()
        found[module] = file
        for name in _imported(module, file):
            other = Path(getattr(sys.modules.get(name), "__file__", None) or "")
            if name not in found and other.suffix == ".py" and _is_users(other):
                waiting[name] = other
    return found


def _imported(module: str, file: Path) -> Iterator[str]:
    """Full names of the modules that a file may import."""
    package = getattr(sys.modules.get(module), "__package__", None) or ""
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            level = "." * node.level
            name = importlib.util.resolve_name(level + (node.module or ""), package)
            yield name
            yield from (f"{name}.{alias.name}" for alias in node.names)


def _is_users(file: Path) -> bool:
    """Neither Python's, nor an installed library's, nor hqp_grasp's."""
    installed = {"site-packages", "dist-packages"} & set(file.parts)
    return not installed and not any(file.is_relative_to(folder) for folder in (STDLIB, PACKAGE))
