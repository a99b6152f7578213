"""Picks under what goes wrong: wrong friction, twice the mass, a sensor that freezes on the way up.

    python benchmarks/picks.py --trials 10 --seed 2028 --jobs 2

The paper's four objects, load cells, 0.5 kg unless said otherwise. Prints, for each, how many were
lifted, stand where they stood, are told with a reason, and fell without one; errors, and the worst
violation of a range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import tyro
from grid import SCENES
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all
from hqp_grasp.experiments.picking import PickSettings, pick_of
from hqp_grasp.world.imperfections import Fault

SETTINGS = PickSettings(preset="loadcell")
CONDITIONS = {
    "friction 0.4, 0.6 believed": replace(SETTINGS, friction=0.6, actual_friction=0.4),
    "1 kg": replace(SETTINGS, mass=1.0),
    "sensor freezes": SETTINGS,
}
INTO_LIFT = 0.3  # [s] after the lift began


def picked(scene: hg.Scene, condition: str, seed: tuple[int, int]) -> hg.Picked:
    """One pick; the sensor's fault begins as a first run of the same seed was lifting."""
    pick = pick_of(scene, CONDITIONS[condition])
    done = pick.attempt(seed)
    if condition != "sensor freezes":
        return done
    begin = next((look["time"] for look in done.looks if look["phase"] == "lift"), 0.0)
    physics = pick.trial.physics
    assert physics is not None and isinstance(begin, float)
    fault = Fault("freeze", seed[1] % 3, begin + INTO_LIFT)
    broken = replace(physics, imperfections=replace(physics.imperfections, faults=(fault,)))
    return replace(pick, trial=replace(pick.trial, probe=broken, preset=None)).attempt(seed)


@dataclass(frozen=True)
class Work:
    """All picks, one after the other."""

    trials: int
    seed: int

    def __call__(self, number: int) -> dict[str, object]:
        """The row of one pick, without its looks."""
        which, i = divmod(number, self.trials)
        condition, name = divmod(which, len(SCENES))
        scene = tuple(SCENES.values())[name]
        return dict(picked(scene, tuple(CONDITIONS)[condition], (self.seed, i)).row)


def main(trials: int = 25, seed: int = 2028, jobs: int = 2) -> None:
    """Print one line for each condition and object.

    Args:
        trials: starts of each
        seed: start i draws from SeedSequence([seed, i])
        jobs: processes
    """
    count = len(CONDITIONS) * len(SCENES) * trials
    found = dict(tqdm(run_all(Work(trials, seed), range(count), jobs), total=count))
    print(f"{'':42}lifted  stands  reason  silent  errors  violation")
    for c, condition in enumerate(CONDITIONS):
        for s, name in enumerate(SCENES):
            first = (c * len(SCENES) + s) * trials
            rows = [found[first + i] for i in range(trials)]
            told = [bool(row["reason"] or row["error"]) for row in rows]
            silent = sum(not row["set_down"] and not t for row, t in zip(rows, told, strict=True))
            figures = (
                sum(bool(row["lifted"]) for row in rows),
                sum(bool(row["set_down"]) for row in rows),
                sum(bool(row["reason"]) for row in rows),
                silent,
                sum(bool(row["error"]) for row in rows),
            )
            worst = max(float(row["limit_violation"] or 0.0) for row in rows)  # type: ignore[arg-type]
            cells = "".join(f"{n:8}" for n in figures)
            print(f"{condition + ', ' + name:40}{cells}  {worst:g} rad")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
