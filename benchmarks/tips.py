"""What tips that are no balls are good for: three hands grasp, by two forms.

    python benchmarks/tips.py --trials 20 --seed 906

The trident is that of docs/any-robot.md, as the page shows it; the others are in
benchmarks/robots/. "Good" is the verdict of `hqp-grasp report`.
"""

from __future__ import annotations

import re
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro

import hqp_grasp as hg

ROOT = Path(__file__).parents[1]
OBJECTS = {"cylinder": hg.Cylinder(0.05), "hexagon": hg.Prism.regular(6, 0.05)}


def trident(folder: Path) -> Path:
    """Write the hand that docs/any-robot.md shows; return its description."""
    page = (ROOT / "docs" / "any-robot.md").read_text(encoding="utf-8")
    for name, text in re.findall(r'^```text title="(.+?)"\n(.*?)^```', page, re.DOTALL | re.M):
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "trident.toml"


@cache
def trial_of(robot: Path, thing: str, form: str, probes: int) -> hg.Trial:
    """The trial; a process builds each scene once."""
    return hg.Trial(hg.Scene(robot, OBJECTS[thing]), hg.stack_of("fmk"), probes, form)


def one(
    robot: Path, thing: str, form: str, probes: int, seed: int, i: int
) -> tuple[str, int | None]:
    """The verdict on trial i, and the probe it converged at."""
    record = trial_of(robot, thing, form, probes).attempt((seed, i))
    return record.verdict, record.converged_at


def main(
    trials: int = 20,
    seed: int = 906,
    probes: int = 40,
    objects: tuple[str, ...] = ("cylinder", "hexagon"),
    forms: tuple[str, ...] = ("hierarchy", "paper"),
    jobs: int = 2,
) -> None:
    """Print, hand by hand, how many trials are good and how the others fail.

    Args:
        trials: random starts of each case
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        objects: what is grasped
        forms: of the controller
        jobs: processes
    """
    print(f"seed {seed}, {probes} probes\n")
    print(f"{'tips':10}{'object':10}{'form':11}{'good':>10}{'median':>8}{'worst':>7}  failures")
    with TemporaryDirectory() as folder, ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        robots = {
            "trident": trident(Path(folder)),
            "capsules": ROOT / "benchmarks" / "robots" / "capsules.toml",
            "boxes": ROOT / "benchmarks" / "robots" / "boxes.toml",
        }
        for name, robot in robots.items():
            for thing in objects:
                for form in forms:
                    work = ([v] * trials for v in (robot, thing, form, probes, seed))
                    ends = list(pool.map(one, *work, range(trials)))
                    good = [probe for verdict, probe in ends if verdict == "good"]
                    kinds = Counter(verdict for verdict, _ in ends if verdict != "good")
                    told = f"{np.median(good):8.1f}{max(good):7}" if good else f"{'–':>8}{'–':>7}"
                    failures = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
                    share = f"{len(good)} of {trials}"
                    print(f"{name:10}{thing:10}{form:11}{share:>10}{told}  {failures}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
