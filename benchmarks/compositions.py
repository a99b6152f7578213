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

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, hexagon, irregular
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all
from hqp_grasp.experiments.record import VERDICTS
from hqp_grasp.experiments.report import interval, paired_difference

SCENES = {"cylinder": cylinder.scene, "hexagon": hexagon.scene, "irregular": irregular.scene}
# Every ordering of every subset whose effect is another than that of a shorter one, "fmk" first.
ORDERS = ["".join(p) for r in (3, 2, 1) for p in permutations("fmk", r) if "k" not in p[:-1]]
SUPERPOSITION = "f+m+k"


@dataclass(frozen=True)
class Composition:
    """Laws in an order, and the form they are composed in."""

    laws: str  # by their letters
    form: str

    @property
    def stack(self) -> hg.Stack:
        if self.laws == SUPERPOSITION:
            return hg.ForceTask() + hg.MomentTask() + hg.KinematicTask()
        return hg.stack_of(self.laws)


COMPOSITIONS = (
    *(Composition(laws, "memoryless") for laws in (*ORDERS, SUPERPOSITION)),
    *(Composition(laws, "paper") for laws in ORDERS if laws != "k"),
    *(Composition(laws, "hierarchy") for laws in ("fmk", "mfk", "fm", "mf", SUPERPOSITION)),
)


@dataclass(frozen=True)
class Work:
    """Trials of each composition on each object; trial i begins alike for all compositions."""

    trials: int
    seed: int
    probes: int

    def __len__(self) -> int:
        return len(SCENES) * len(COMPOSITIONS) * self.trials

    def __call__(self, number: int) -> tuple[str, int | None]:
        """The trial's verdict, and the probe from which it stays balanced."""
        cell, i = divmod(number, self.trials)
        scene, composition = divmod(cell, len(COMPOSITIONS))
        chosen = COMPOSITIONS[composition]
        trial = hg.Trial(tuple(SCENES.values())[scene], chosen.stack, self.probes, form=chosen.form)
        record = trial.attempt((self.seed, i))
        return record.verdict, record.converged_at


def table(found: Sequence[Sequence[tuple[str, int | None]]]) -> str:
    """One row a composition, given verdict and probe of each trial, f ▷ m ▷ k first."""
    kinds = [kind for kind in VERDICTS[1:] if any(kind == v for row in found for v, _ in row)]
    heads = "".join(f"{kind:>14}" for kind in kinds)
    rows = [f"{'':18}{'good [95 %]':>19}{heads}{'probes':>12}  good − fmk [95 %]"]
    reference = [verdict == "good" for verdict, _ in found[0]]
    for composition, row in zip(COMPOSITIONS, found, strict=True):
        good = [verdict == "good" for verdict, _ in row]
        count = Counter(verdict for verdict, _ in row)
        low, high = interval(sum(good), len(good))
        told = f"{sum(good):>4} [{low:6.1%}, {high:6.1%}]" + "".join(
            f"{count[k]:>14}" for k in kinds
        )
        at = [probe for _, probe in row if probe is not None]
        probes_to = f"{np.median(at):g} ({max(at)})" if at else "–"
        difference, least, most = paired_difference(reference, good)
        against = f"{difference:+7.1%} [{least:+.1%}, {most:+.1%}]" if row is not found[0] else ""
        rows.append(
            f"{composition.laws:6}{composition.form:12}{told}{probes_to:>12}  {against}".rstrip()
        )
    return "\n".join(rows)


def main(trials: int = 100, seed: int = 31, probes: int = 40, jobs: int = 2) -> None:
    """Print one table an object.

    Args:
        trials: random starts, the same for every composition
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        jobs: processes
    """
    work = Work(trials, seed, probes)
    done = dict(tqdm(run_all(work, range(len(work)), jobs), total=len(work)))
    each = [[done[i] for i in range(k, k + trials)] for k in range(0, len(work), trials)]
    for s, scene in enumerate(SCENES):
        print(f"\n{scene}, {trials} starts of seed {seed}, {probes} probes\n")
        print(table(each[s * len(COMPOSITIONS) : (s + 1) * len(COMPOSITIONS)]))


if __name__ == "__main__":
    tyro.cli(main)
