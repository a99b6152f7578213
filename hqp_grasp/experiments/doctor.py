"""What of hqp_grasp works on this machine: versions, extras, the solver, browser and renderer."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import event

from hqp_grasp import kernels
from hqp_grasp.errors import requirements
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.hierarchy import active_set
from hqp_grasp.hierarchy.hqp import HQP
from hqp_grasp.hierarchy.level import Level
from hqp_grasp.tasks import stack_of
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.description import CLEARANCE
from hqp_grasp.world.scene import Scene

BROWSERS = ("chromium", "chromium-browser")  # what `make test-all` drives
RENDERER = """
import mujoco
context = mujoco.GLContext(8, 8)
context.make_current()
from OpenGL import GL
print(GL.glGetString(GL.GL_RENDERER).decode())
"""
PATIENCE = 60.0  # [s] for a renderer to answer


def doctor() -> str:
    """The report. It tries all that is compiled, so that nothing is left to compile after it."""
    needed = requirements()
    lines = [
        f"hqp_grasp  {version('hqp_grasp')}, {Path(kernels.__file__).parent}",
        f"python     {platform.python_version()}, {sys.executable}",
        f"needs      {_versions(needed.pop(''))}",
        "extras",
        *(f"  {extra:9}{_versions(packages)}" for extra, packages in sorted(needed.items())),
        f"solver     {_solver()}",
        f"browser    {_browser()}",
        f"renderer   {_renderer()}",
    ]
    return "\n".join(lines)


def _versions(packages: dict[str, str]) -> str:
    """Packages with what is installed of them, and the line that installs the others."""
    there, absent = [], []
    for name, needed in packages.items():
        try:
            there.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            absent.append(f"'{needed}'")
    if absent:
        there.append(f"missing: pip install {' '.join(absent)}")
    return ", ".join(there)


def _solver() -> str:
    """Whether all kernels were compiled before, tried one by one, and where they are kept."""
    with event.install_recorder("numba:compile") as recorder:
        began = time.perf_counter()
        levels = [Level.equal(np.eye(2), np.ones(2))]
        solution = HQP().solve(levels)
        scene = Scene("bhand")
        Trial(scene, stack_of("fmk"), probes=1).run(1)
        SelfClearance(scene.articulated, CLEARANCE).near(scene.articulated.home, CLEARANCE)
    took = time.perf_counter() - began
    if not solution.is_optimal(levels):
        return f"NOT RIGHT: {solution.method} found no certified answer to a trivial problem"
    compiled = any(
        each.data["dispatcher"].py_func.__module__.startswith("hqp_grasp.")
        for _, each in recorder.buffer
    )
    how = "compiled just now" if compiled else "compiled before, and loaded"
    how = f"{how}, in {took:.1f} s"
    if kernels.homeless:
        return f"{how}\n{kernels.HOMELESS}"
    dispatcher: Any = active_set.spectral_norm
    kept = dispatcher.stats.cache_path
    return f"{how}; kept in {kept}"


def _browser() -> str:
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        return "no chromium on the path; only `make test-all` and `make pictures` need one"
    return f"{path} (replays open in any)"


def _renderer() -> str:
    """What draws for MuJoCo without a display; asked in a process that may die of it."""
    command = [sys.executable, "-c", RENDERER]
    try:
        said = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=True,
            timeout=PATIENCE,
            env=os.environ | {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl"},
        ).stdout
    except (subprocess.SubprocessError, OSError):
        return "no EGL; nothing here needs one"
    return f"EGL: {said.strip()}"
