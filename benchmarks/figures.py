"""The paper's Figures 3, 4a–c and 6, drawn from trials of today, with the data beside them.

    python benchmarks/figures.py --out docs/images --data docs/data --jobs 2

Four sets of 40 trials of 60 probes: the composite f ▷ m ▷ k on the cylinder, the hexagon and the
irregular prism, and f ▷ m on the cylinder.
"""

from __future__ import annotations

import csv
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tyro
from hqp_grasp.scenarios import cylinder, hexagon, irregular
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import hqp_grasp as hg

SCENES = {"cylinder": cylinder.scene, "hexagon": hexagon.scene, "irregular": irregular.scene}
SETS = (("cylinder", "fmk"), ("hexagon", "fmk"), ("irregular", "fmk"), ("cylinder", "fm"))
START, END = "#222222", "#d55e00"
COLUMNS = ("eps_f", "eps_m", "eps_k", "adduction_deg", "elevation_deg")


@dataclass(frozen=True)
class Set:
    """The trials of one object and one stack: each column (trials, probes + 1), NaN at a miss."""

    scene: str
    stack: str
    columns: dict[str, np.ndarray]
    verdicts: tuple[str, ...]


def one(scene: str, stack: str, form: str, probes: int, seed: int, i: int) -> hg.Record:
    trial = hg.Trial(SCENES[scene], hg.stack_of(stack), probes, form=form)
    return trial.attempt((seed, i))


def collect(form: str, trials: int, probes: int, seed: int, jobs: int) -> list[Set]:
    """Run all four sets."""
    work = [(scene, stack, i) for scene, stack in SETS for i in range(trials)]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        scenes, stacks, numbers = zip(*work, strict=True)
        settings = (repeat(form), repeat(probes), repeat(seed))
        records = list(pool.map(one, scenes, stacks, *settings, numbers, chunksize=5))
    sets = []
    for k, (scene, stack) in enumerate(SETS):
        own = records[k * trials : (k + 1) * trials]
        columns = {name: np.array([r.column(name) for r in own], dtype=float) for name in COLUMNS}
        sets.append(Set(scene, stack, columns, tuple(record.verdict for record in own)))
    return sets


def figure_3(found: Set) -> Figure:
    """Mean of the three errors over the probes, and their standard deviation."""
    figure = _figure(3)
    labels = (r"$\varepsilon_f$ [N²]", r"$\varepsilon_m$ [(N·m)²]", r"$\varepsilon_k$ [rad]")
    for axes, name, label in zip(figure.axes, COLUMNS, labels, strict=False):
        values = found.columns[name]
        mean, spread = np.nanmean(values, axis=0), np.nanstd(values, axis=0)
        probes = np.arange(len(mean))
        axes.fill_between(probes, np.maximum(mean - spread, 0), mean + spread, alpha=0.25)
        axes.plot(probes, mean)
        axes.set(xlabel="probe", ylabel=label, ylim=(0, None))
    return figure


def figure_4(sets: list[Set]) -> Figure:
    """Where the hand begins and ends, in adduction and in elevation of the approach axis."""
    figure = _figure(len(sets))
    for axes, found in zip(figure.axes, sets, strict=True):
        _postures(axes, found)
        axes.set_title(found.scene)
    figure.axes[0].legend(loc="lower right")
    return figure


def figure_6(without: Set, composite: Set) -> Figure:
    """Postures without the kinematic law beside those with it."""
    figure = _figure(2)
    for axes, found, title in zip(
        figure.axes, (without, composite), (r"$\Phi_{fm}$", r"$\Phi_{fmk}$"), strict=True
    ):
        _postures(axes, found)
        axes.set_title(title)
    figure.axes[0].legend(loc="lower right")
    return figure


def _postures(axes: Axes, found: Set) -> None:
    adduction, elevation = found.columns["adduction_deg"], found.columns["elevation_deg"]
    axes.plot(adduction[:, 0], elevation[:, 0], ".", color=START, label="start")
    ends = [_last(adduction), _last(elevation)]
    axes.plot(*ends, "o", mfc="none", color=END, label="end")
    axes.set(xlabel="adduction [°]", ylabel="elevation [°]", xlim=(0, 130), ylim=(20, 95))


def _last(values: np.ndarray) -> np.ndarray:
    """The last number of each row."""
    return np.array([row[np.isfinite(row)][-1] for row in values])


def _figure(panels: int) -> Figure:
    figure = Figure(figsize=(4.2 * panels, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.subplots(1, panels)
    return figure


def write_data(sets: list[Set], path: Path) -> None:
    """Every number drawn: one row a trial and probe."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["object", "stack", "trial", "probe", *COLUMNS])
        for found in sets:
            shape = found.columns["eps_f"].shape
            for i, k in np.ndindex(*shape):
                values = [found.columns[name][i, k] for name in COLUMNS]
                told = ["" if np.isnan(value) else f"{value:.6g}" for value in values]
                rows.writerow([found.scene, found.stack, i, k, *told])


def main(
    out: Path = Path("docs/images"),
    data: Path = Path("docs/data"),
    form: str = "hierarchy",
    trials: int = 40,
    probes: int = 60,
    seed: int = 40,
    jobs: int = 2,
) -> None:
    """Run the trials, draw the figures, and print what they show.

    Args:
        out: folder of the pictures
        data: folder of the numbers, figures.csv
        form: of the composition; its name is in the names of the files unless it is the hierarchy
        trials: of each set
        probes: touches after the first
        seed: trial i draws from SeedSequence([seed, i])
        jobs: processes
    """
    begin = time.perf_counter()
    sets = collect(form, trials, probes, seed, jobs)
    out.mkdir(parents=True, exist_ok=True)
    data.mkdir(parents=True, exist_ok=True)
    tail = "" if form == "hierarchy" else f"-{form}"
    figure_3(sets[0]).savefig(out / f"figure-3{tail}.png", dpi=110)
    figure_4(sets[:3]).savefig(out / f"figure-4{tail}.png", dpi=110)
    figure_6(sets[3], sets[0]).savefig(out / f"figure-6{tail}.png", dpi=110)
    write_data(sets, data / f"figures{tail}.csv")
    print(f"{trials} trials of {probes} probes each, seed {seed}, form {form}\n")
    print(f"{'':16}{'good':>6}{'adduction at the end':>24}{'elevation':>18}{'angle [rad]':>16}")
    for found in sets:
        cells = [_last(found.columns[name]) for name in COLUMNS[3:]]
        told = [f"{values.mean():.1f} ± {values.std():.1f}°" for values in cells]
        angle = _last(found.columns["eps_k"])
        good = sum(verdict == "good" for verdict in found.verdicts)
        name = f"{found.scene} {found.stack}"
        print(
            f"{name:16}{good:>6}{told[0]:>24}{told[1]:>18}"
            f"{f'{angle.mean():.2f} ± {angle.std():.2f}':>16}"
        )
    print(f"\n{time.perf_counter() - begin:.1f} s with {jobs} processes")


if __name__ == "__main__":
    tyro.cli(main)
