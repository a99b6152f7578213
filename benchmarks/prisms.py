"""Grasps that do not balance must not fail either: whole trials on boxes and regular prisms.

    python benchmarks/prisms.py --seed 0

80 trials each on boxes of 6, 8 and 10 cm, 60 on a triangle, a pentagon and an octagon. Parallel
normals and edges are what these have in common. Counts trials by the kinds of `python -m hqp_grasp
report`.
"""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import tyro

import hqp_grasp as hg
from hqp_grasp.experiments.record import VERDICTS


def box(side: float) -> hg.Prism:
    half = side / 2.0
    return hg.Prism(((half, half), (-half, half), (-half, -half), (half, -half)))


OBJECTS = {
    "box, 6 cm": (box(0.06), 80),
    "box, 8 cm": (box(0.08), 80),
    "box, 10 cm": (box(0.10), 80),
    "triangle, 9 cm sides": (hg.Prism.regular(3, 0.09), 60),
    "pentagon, 6 cm sides": (hg.Prism.regular(5, 0.06), 60),
    "octagon, 4 cm sides": (hg.Prism.regular(8, 0.04), 60),
}


def one(name: str, seed: int, probes: int, i: int) -> tuple[str, str | None]:
    """Verdict and error of one trial."""
    stack = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
    record = hg.Trial(hg.Scene(object=OBJECTS[name][0]), stack, probes).attempt((seed, i))
    return record.verdict, record.error


def main(seed: int = 0, probes: int = 30, jobs: int = 2) -> None:
    """Print the kinds, object by object.

    Args:
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        jobs: processes
    """
    print(f"seed {seed}, {probes} probes\n")
    print(f"{'':22}{'trials':>8}" + "".join(f"{kind:>14}" for kind in VERDICTS))
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for name, (_, trials) in OBJECTS.items():
            work = ([name] * trials, [seed] * trials, [probes] * trials, range(trials))
            found = list(pool.map(one, *work, chunksize=10))
            count = Counter(verdict for verdict, _ in found)
            print(f"{name:22}{trials:8}" + "".join(f"{count[kind]:14}" for kind in VERDICTS))
            for i, (_, error) in enumerate(found):
                if error is not None:
                    print(f"  trial {i}: {error}")


if __name__ == "__main__":
    tyro.cli(main)
