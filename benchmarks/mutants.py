"""Spoil the code in one place at a time, and see whether the tests notice: `make mutants`."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).parents[1]
TREE = ("hqp_grasp", "robots", "scenarios", "tests", "docs", "benchmarks")  # what tests read
FILES = ("pyproject.toml", "README.md", "CONTRIBUTING.md", "Makefile")
LONGEST = 900  # [s] a run of the tests may take; one that hangs has noticed


@dataclass(frozen=True)
class Mutant:
    """One edit: within the symbol `place`, the one occurrence of `old` becomes `new`.

    `place` is "folder/file.py:name", a function, a class, a constant, or "Class.method" of
    hqp_grasp. `tests` are the folders or files of tests/ to try first; the others follow.
    """

    place: str
    old: str
    new: str
    tests: str

    @property
    def path(self) -> Path:
        return Path("hqp_grasp") / self.place.split(":")[0]

    def applied(self, source: str) -> str:
        """The edited source; ValueError where the symbol, or `old` in it, is not found once."""
        name = self.place.split(":")[1]
        begin, end = lines_of(source, name)
        lines = source.splitlines(keepends=True)
        symbol = "".join(lines[begin:end])
        if symbol.count(self.old) != 1:
            raise ValueError(f"{self.place} holds {self.old!r} {symbol.count(self.old)} times")
        edited = symbol.replace(self.old, self.new)
        return "".join([*lines[:begin], edited, *lines[end:]])


TRIAL, STUDY, SCENE = (f"experiments/test_{name}.py" for name in ("trial", "study", "scenario"))
PARTS = "experiments/test_parts.py"
PRINTS = "experiments/test_fingerprint.py"

MUTANTS = (
    # The gap between hierarchy and projection is the smallest difference instead of the largest.
    Mutant("control/forms.py:_hierarchy", "unlimited).max())", "unlimited).min())", "control"),
    # A clipped step is not scaled to its caps first.
    Mutant(
        "control/forms.py:clip_to_limits", "x / max(1.0, cap_ratio(x, stack, grasp))", "x", TRIAL
    ),
    # A warm start is not used.
    Mutant("hierarchy/hqp.py:HQP._ways", "warm is not None and", "False and", "hierarchy"),
    # Trials count as converged before a relapse.
    Mutant("experiments/scenario.py:summary", "stays.argmax(", "good.argmax(", SCENE),
    # Axes are swapped.
    Mutant(
        "experiments/plots.py:convergence_figure",
        "right.plot(adduction[:, 0], elevation[:, 0]",
        "right.plot(elevation[:, 0], adduction[:, 0]",
        SCENE,
    ),
    # The moment is drawn as the angle.
    Mutant("experiments/plots.py:convergence_figure", "middle, angle", "middle, moment", SCENE),
    # What mink's limits hold is not told.
    Mutant(
        "experiments/fingerprint.py:Fingerprint._held", "if not k.starts", "if k.starts", PRINTS
    ),
    # Links count only deep in the object.
    Mutant("touch/geometric.py:OVERLAP", "1e-7", "1e-3", "touch"),
    # Workers have all the threads that they like.
    Mutant("experiments/executor.py:_in_processes", "_one_blas_thread()", "ExitStack()", STUDY),
    Mutant("control/forms.py:TOUCH_RANK", "1e-6", "1e-9", "control"),
    Mutant("control/landing.py:LANDING_STEPS", "3", "1", "control"),
    Mutant("control/landing.py:LANDING_DAMPING", "1e-2", "1e-1", "control"),
    Mutant("touch/geometric.py:RETREAT", "0.35", "0.15", "touch"),
    # RIDGE and MET are gone: an uncertified answer is returned; lower laws disturb higher ones.
    Mutant("hierarchy/hqp.py:HQP.solve", "if not judged.faults:", "if True:", "hierarchy"),
    Mutant("hierarchy/projection.py:Projection.solve", "Vt[rank:].T", "Vt.T", "hierarchy"),
    # Up to here the 15 that survived once; from here 13 more. A slide is taken for a hinge.
    Mutant("world/robot.py:Robot.hessian", " * self._hinge[:, None]", "", "world"),
    # A coupling's constant is ignored.
    Mutant("world/robot.py:_couplings", "at_zero + coefficients[0]", "at_zero", "world"),
    # Motion and rotation change places.
    Mutant("world/robot.py:Robot.palm_jacobian", "J[:3], J[3:]", "J[3:], J[:3]", "world"),
    # The model does not count in a fingerprint.
    Mutant(
        "experiments/fingerprint.py:Fingerprint._describe",
        "buffer.tobytes()",
        'b""',
        PRINTS,
    ),
    # The centroid stays while contacts move.
    Mutant("tasks/moment.py:MomentTask.contact_jacobian", "f / grasp.k", "0.0 * f", "tasks"),
    # Clearances come before caps.
    Mutant("tasks/stack.py:Stack.limit_levels", "self.limits})", "self.limits})[::-1]", "tasks"),
    # The sign of a Jacobian.
    Mutant("tasks/kinematic.py:_turn", "np.copysign(1.0, cosine)", "np.ones_like(cosine)", "tasks"),
    # Limits in the order given instead of their own.
    Mutant("control/ik.py:ik_levels", "sorted(limits, key=_priority)", "limits", "control"),
    # The moment's step disturbs the force.
    Mutant(
        "control/paper.py:contact_step", "_nullspace(above)", "_nullspace(0 * above)", "control"
    ),
    # A tip stops a thousandth of a millimetre off the surface.
    Mutant("touch/geometric.py:TOUCH", "1e-9", "1e-6", "touch"),
    # Trials of one number are alike in every study.
    Mutant(
        "experiments/trial.py:Trial.begin", "Sequence(entropy)", "Sequence(entropy[-1:])", TRIAL
    ),
    # A killed run leaves half a file.
    Mutant(
        "experiments/parts.py:_write", 'path.with_suffix(f".{os.getpid()}.part")', "path", PARTS
    ),
    # A damped level forgets those above it.
    Mutant("hierarchy/hqp.py:HQP.damped", "[*held, Level(", "[Level(", "hierarchy"),
)


def lines_of(source: str, name: str) -> tuple[int, int]:
    """The lines begin:end of a symbol, decorators aside."""
    node: ast.AST = ast.parse(source)
    for part in name.split("."):
        inside = [n for n in ast.iter_child_nodes(node) if part in names_of(n)]
        if len(inside) != 1:
            raise ValueError(f"{name} is defined {len(inside)} times")
        node = inside[0]
    assert isinstance(node, ast.stmt) and node.end_lineno is not None
    return node.lineno - 1, node.end_lineno


def names_of(node: ast.AST) -> list[str]:
    """What a statement defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [target.id for target in targets if isinstance(target, ast.Name)]


def copied(folder: Path) -> Path:
    """A copy of the tree in `folder`, with what numba has compiled."""
    for name in TREE:
        shutil.copytree(ROOT / name, folder / name)
    for name in FILES:
        shutil.copy2(ROOT / name, folder / name)
    return folder


def failure(tree: Path, tests: str) -> str:
    """The first test that fails in `tree`, those of `tests` tried first; empty where none does."""
    folders = [*(f"tests/{name}" for name in tests.split()), "tests"]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *folders]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return f"longer than {LONGEST} s"
    if done.returncode == 0:
        return ""
    failed = re.findall(r"^(?:FAILED|ERROR) tests/(.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if not failed:
        raise RuntimeError(f"pytest did not run:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return str(failed[0])


def judge(mutant: Mutant) -> str:
    """The test that notices the mutant; empty where none does."""
    with tempfile.TemporaryDirectory() as folder:
        tree = copied(Path(folder))
        path = tree / mutant.path
        source = path.read_text(encoding="utf-8")
        path.write_text(mutant.applied(source), encoding="utf-8")
        if "numba" in source:  # what is compiled may hold the old constants
            for kept in (tree / "hqp_grasp").rglob("*.nb[ci]"):
                kept.unlink()
        return failure(tree, mutant.tests)


def main(only: str = "", jobs: int = 2, survivors: int = 2) -> None:
    """Try every mutant; exit with an error where more than `survivors` live.

    Args:
        only: Try those whose place or edit holds this text.
        jobs: Mutants tried at a time.
        survivors: How many may live.
    """
    chosen = [m for m in MUTANTS if only in f"{m.place} {m.old} → {m.new}"]
    stale = []
    for mutant in chosen:  # all of them before any test is run
        try:
            mutant.applied((ROOT / mutant.path).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            stale.append(f"{mutant.place}: {error}")
    if stale:
        sys.exit("point these mutants to where the code is now:\n" + "\n".join(stale))
    with tempfile.TemporaryDirectory() as folder:
        broken = failure(copied(Path(folder)), "")
    if broken:
        sys.exit(f"the tests fail without any mutant: {broken}")
    begin = time.monotonic()
    alive = 0
    with ThreadPoolExecutor(jobs) as pool:
        for mutant, noticed in zip(chosen, pool.map(judge, chosen), strict=True):
            alive += not noticed
            verdict = f"killed by {noticed}" if noticed else "SURVIVED"
            print(f"{mutant.place}: {mutant.old} → {mutant.new}\n    {verdict}", flush=True)
    minutes = (time.monotonic() - begin) / 60.0
    print(f"\n{len(chosen) - alive} of {len(chosen)} killed, in {minutes:.0f} minutes")
    if alive > survivors:
        sys.exit(f"{alive} survive; {survivors} may")


if __name__ == "__main__":
    tyro.cli(main)
