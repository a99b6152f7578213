"""From how many draws of the paper's ranges the hand finds a first touch, and how long it takes.

    python benchmarks/starts.py --draws 200 --seed 0
    python benchmarks/starts.py --object FILE --plot starts.png

A histogram over adduction and elevation: found of drawn, and at the end why draws were rejected.
"""

from __future__ import annotations

import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, cylinder_65, hexagon, irregular

import hqp_grasp as hg

SCENES = {
    "cylinder": cylinder.scene,
    "cylinder_65": cylinder_65.scene,
    "hexagon": hexagon.scene,
    "irregular": irregular.scene,
}
ADDUCTION = np.radians(np.linspace(10.0, 90.0, 6))  # edges of the histogram
ELEVATION = np.radians(np.linspace(30.0, 50.0, 5))


def measure(
    scene: hg.Scene, draws: int, seed: int
) -> tuple[np.ndarray, np.ndarray, list[float], Counter[str]]:
    """Adduction, elevation (draws, 2), found (draws,), CPU seconds of each, why some were not."""
    probe = hg.GeometricProbe(scene)
    hg.Start().draw(scene, lambda _: probe, np.random.default_rng(0))  # compiles the solver
    drawn, found, seconds, why = np.zeros((draws, 2)), np.zeros(draws, bool), [], Counter[str]()
    for i in range(draws):
        rng = np.random.default_rng([seed, i])
        a, e = rng.uniform(ADDUCTION[0], ADDUCTION[-1]), rng.uniform(ELEVATION[0], ELEVATION[-1])
        drawn[i] = a, e
        begin = time.process_time()
        try:
            hg.Start((a, a), (e, e), max_draws=1).draw(scene, lambda _: probe, rng)
            found[i] = True
        except hg.ReachError as error:
            why.update(error.reasons)
        seconds.append(time.process_time() - begin)
    return drawn, found, seconds, why


def main(
    draws: int = 200, seed: int = 0, object: Path | None = None, plot: Path | None = None
) -> None:
    """Measure the paper's objects, or one from a file."""
    scenes = {object.stem: hg.Scene(object=hg.Body(object))} if object else SCENES
    fig, panels = plt.subplots(
        2, len(scenes), squeeze=False, figsize=(3.2 * len(scenes), 4.5), layout="constrained"
    )
    for (name, scene), column in zip(scenes.items(), panels.T, strict=True):
        drawn, found, seconds, why = measure(scene, draws, seed)
        each = 1e3 * sum(seconds) / max(1, found.sum())
        print(f"\n{name}: {found.sum()} of {draws} draws touch, {each:.1f} ms of CPU each")
        bins = [ADDUCTION, ELEVATION]
        count = np.histogram2d(*drawn.T, bins)[0].astype(int)
        kept = np.histogram2d(*drawn[found].T, bins)[0].astype(int)
        ends = np.degrees(ADDUCTION).round().astype(int)
        heads = (f"{low}-{high}°" for low, high in pairwise(ends))
        print(f"{'elevation':10}" + "".join(f"{head:>10}" for head in heads) + "  adduction")
        for j in range(count.shape[1]):
            low, high = np.degrees(ELEVATION[j : j + 2]).round().astype(int)
            cells = (f"{kept[i, j]}/{count[i, j]}" for i in range(count.shape[0]))
            print(f"{f'{low}-{high}°':10}" + "".join(f"{cell:>10}" for cell in cells))
        for reason, times in why.most_common():
            print(f"  rejected {times}: {reason}")
        for panel, values, edges, label in zip(
            column, drawn.T, bins, ("adduction", "elevation"), strict=True
        ):
            panel.hist(np.degrees(values), np.degrees(edges), color="0.85", label="drawn")
            panel.hist(np.degrees(values[found]), np.degrees(edges), histtype="step", label="found")
            panel.set_xlabel(f"{label} [°]")
        column[0].set_title(name)
    if plot:
        panels[0, 0].legend()
        fig.savefig(plot, dpi=150)
        print(f"\nfigure {plot}")


if __name__ == "__main__":
    tyro.cli(main)
