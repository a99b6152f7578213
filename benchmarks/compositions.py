"""Every composition of the three laws, from the same starts: which order matters, and how much.

    python benchmarks/compositions.py --trials 100 --seed 31 --jobs 2

Every ordering of every subset of force, moment and kinematic law in joint space, their direct
superposition on one level (which the paper argues against), and in contact space (the paper's eq.
11–13) each ordering that has such a form: the kinematic law last. A star marks the latter. "Good"
and the kinds of failure are those of `python -m hqp_grasp report`; the last column is the
difference to f ▷ m ▷ k, in pairs of the same start.
"""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import permutations
from multiprocessing import get_context

import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, hexagon, irregular
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.record import VERDICTS
from hqp_grasp.experiments.report import interval, paired_difference

SCENES = {"cylinder": cylinder.scene, "hexagon": hexagon.scene, "irregular": irregular.scene}
ORDERS = ["".join(p) for r in (1, 2, 3) for p in permutations("fmk", r)]
REFERENCE = "fmk"


@dataclass(frozen=True)
class Composition:
    """Laws in an order, and the space they are composed in."""

    name: str  # letters; f+m+k is the superposition, a star means contact space

    @property
    def form(self) -> str:
        return "paper" if self.name.endswith("*") else "hierarchy"

    @property
    def stack(self) -> hg.Stack:
        if "+" in self.name:
            return hg.ForceTask() + hg.MomentTask() + hg.KinematicTask()
        return hg.stack_of(self.name.rstrip("*"))


def compositions() -> list[Composition]:
    """All of them, f ▷ m ▷ k first."""
    joint = [REFERENCE, "f+m+k", *(order for order in ORDERS if order != REFERENCE)]
    contact = [f"{order}*" for order in ORDERS if "k" not in order[:-1] and order != "k"]
    return [Composition(name) for name in (*joint, *contact)]


@dataclass(frozen=True)
class Job:
    """One trial of one composition on one object."""

    scene: str
    composition: Composition
    seed: int
    trial: int
    probes: int


def run(job: Job) -> tuple[str, int | None]:
    """The trial's verdict, and the probe from which it stays balanced."""
    trial = hg.Trial(
        SCENES[job.scene], job.composition.stack, job.probes, form=job.composition.form
    )
    record = trial.attempt((job.seed, job.trial))
    return record.verdict, record.converged_at


def main(trials: int = 100, seed: int = 31, probes: int = 40, jobs: int = 2) -> None:
    """Print one table an object.

    Args:
        trials: random starts, the same for every composition
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        jobs: processes
    """
    work = [
        Job(scene, composition, seed, i, probes)
        for scene in SCENES
        for composition in compositions()
        for i in range(trials)
    ]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        done = dict(
            zip(work, tqdm(pool.map(run, work, chunksize=10), total=len(work)), strict=True)
        )
    for scene in SCENES:
        print(f"\n{scene}, {trials} starts of seed {seed}, {probes} probes\n")
        heads = "".join(f"{kind:>14}" for kind in VERDICTS[1:])
        print(f"{'':8}{'good [95 %]':>22}{heads}{'probes':>12}{'good − fmk [95 %]':>28}")
        known: list[bool] = []
        for composition in compositions():
            found = [done[Job(scene, composition, seed, i, probes)] for i in range(trials)]
            good = [verdict == "good" for verdict, _ in found]
            known = known or good
            count = Counter(verdict for verdict, _ in found)
            low, high = interval(sum(good), trials)
            at = [probe for _, probe in found if probe is not None]
            kinds = "".join(f"{count[kind]:>14}" for kind in VERDICTS[1:])
            probes_to = f"{np.median(at):g} ({max(at)})" if at else "–"
            difference, least, most = paired_difference(known, good)
            print(
                f"{composition.name:8}{sum(good):>6} [{low:5.1%}, {high:6.1%}]{kinds}"
                f"{probes_to:>12}{difference:>+10.1%} [{least:+.1%}, {most:+.1%}]"
            )


if __name__ == "__main__":
    tyro.cli(main)
