"""Every composition of the three laws, from the same starts: which order matters, and how much.

    python benchmarks/compositions.py --trials 100 --seed 31

Every ordering of every subset of force, moment and kinematic law, and their direct superposition on
one level (f+m+k, which the paper argues against), each in up to three forms. "memoryless" composes
in joint space, by the last grasp alone. "paper" composes in contact space (eq. 11–13), where that
is defined: the kinematic law last. "hierarchy", the default, plans otherwise than "memoryless" only
where force and moment both are there; with fewer laws all it adds is to settle. The kinematic law
asks for a step of every joint, so what stands below it is never felt: fkm is fk, mkf is mk, and all
that begin with k are k. "Good" and the kinds of failure are those of `hqp-grasp report`;
the last column is the difference to memoryless f ▷ m ▷ k, in pairs of the same start.
"""

from __future__ import annotations

from itertools import permutations, product

from grid import SCENES, Runs, command, table

import hqp_grasp as hg
from hqp_grasp.experiments.report import paired_difference

RUNS = Runs(100, 31)
# Every ordering of every subset whose effect is another than that of a shorter one, "fmk" first.
ORDERS = ["".join(p) for r in (3, 2, 1) for p in permutations("fmk", r) if "k" not in p[:-1]]
SUPERPOSITION = "f+m+k"


COMPOSITIONS = (
    *((laws, "memoryless") for laws in (*ORDERS, SUPERPOSITION)),
    *((laws, "paper") for laws in ORDERS if laws != "k"),
    *((laws, "hierarchy") for laws in ("fmk", "mfk", "fm", "mf", SUPERPOSITION)),
)


def stack_of(laws: str) -> hg.Stack:
    """Laws in an order, by their letters, or all at one priority."""
    if laws == SUPERPOSITION:
        return hg.Stack.of(hg.ForceTask() + hg.MomentTask() + hg.KinematicTask())
    return hg.stack_of(laws)


def main(runs: Runs = RUNS, probes: int = 40) -> None:
    """Print one table an object.

    Args:
        runs: trials
        probes: touches after the first
    """
    names = ("cylinder", "hexagon", "irregular")
    cells = {
        f"{name} {laws} {form}": hg.Trial(SCENES[name], stack_of(laws), probes, form=form)
        for name, (laws, form) in product(names, COMPOSITIONS)
    }
    found = runs.of(cells)
    for name in names:
        own = {
            cell.removeprefix(f"{name} "): e
            for cell, e in found.items()
            if cell.startswith(f"{name} ")
        }
        first, *rows = table(own).splitlines()
        print(f"\n{name}, {runs}, {probes} probes\n\n{first}")
        reference = [end.verdict == "good" for end in next(iter(own.values()))]
        for row, ends in zip(rows, own.values(), strict=True):
            gap = paired_difference(reference, [end.verdict == "good" for end in ends])
            told = "good − fmk {:+.0%} [{:+.0%}, {:+.0%}]".format(*gap)
            print(f"{row:{max(map(len, rows))}}  {told}")


if __name__ == "__main__":
    command(main)
