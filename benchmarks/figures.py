"""The paper's Figures 3, 4a–c and 6, drawn from trials of today, with the data beside them.

    python benchmarks/figures.py
    python benchmarks/figures.py --form paper

Four sets of 40 trials of 60 probes: the composite f ▷ m ▷ k on the cylinder, the hexagon and the
irregular prism, and f ▷ m on the cylinder.
"""

from __future__ import annotations

import csv
import resource
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro
from grid import SCENES
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all

SETS = (("cylinder", "fm"), ("cylinder", "fmk"), ("hexagon", "fmk"), ("irregular", "fmk"))
# What is drawn, and how each number is written.
COLUMNS = {
    "eps_f": "{:.3g}",
    "eps_m": "{:.3g}",
    "eps_k": "{:.3f}",
    "adduction_deg": "{:.1f}",
    "elevation_deg": "{:.1f}",
}
INK, END, GRID = "#333333", "#d55e00", "#e6e6e6"
ERRORS = (  # column, colour, factor, label
    ("eps_f", "#0072b2", 1.0, r"force  $\varepsilon_f$  [N²]"),
    ("eps_m", "#d55e00", 1e6, r"moment  $\varepsilon_m$  [(N·mm)²]"),
    ("eps_k", "#009e73", 1.0, r"posture  $\varepsilon_k$  [rad]"),
)
STYLE = {
    "font.size": 10,
    "axes.edgecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Work:
    """The trials of all sets, one after the other."""

    form: str
    trials: int
    probes: int
    seed: int

    def __call__(self, number: int) -> hg.Record:
        k, i = divmod(number, self.trials)
        scene, stack = SETS[k]
        trial = hg.Trial(SCENES[scene], hg.stack_of(stack), self.probes, form=self.form)
        return trial.attempt((self.seed, i))


@dataclass(frozen=True)
class Set:
    """The trials of one object and one stack: each column (trials, probes + 1), NaN at a miss."""

    scene: str
    stack: str
    columns: dict[str, np.ndarray]
    verdicts: tuple[str, ...]

    @property
    def good(self) -> np.ndarray:
        """Which trials (trials,) are good in every respect."""
        return np.array([verdict == "good" for verdict in self.verdicts])

    @property
    def ends(self) -> np.ndarray:
        """Adduction and elevation (2, trials) at the last touch [°]."""
        return np.array([last(self.columns[name]) for name in ("adduction_deg", "elevation_deg")])


def collect(work: Work, jobs: int) -> list[Set]:
    """Run all four sets."""
    done = dict(run_all(work, range(len(SETS) * work.trials), jobs))
    sets = []
    for k, (scene, stack) in enumerate(SETS):
        own = [done[k * work.trials + i] for i in range(work.trials)]
        columns = {name: np.array([r.column(name) for r in own], dtype=float) for name in COLUMNS}
        sets.append(Set(scene, stack, columns, tuple(record.verdict for record in own)))
    return sets


def last(values: np.ndarray) -> np.ndarray:
    """The last number of each row."""
    return np.array([row[np.isfinite(row)][-1] for row in values])


def figure_3(found: Set) -> Figure:
    """Mean of the three errors over the probes and their standard deviation; on a log scale too."""
    figure = _figure(3)
    for axes, (name, color, factor, label) in zip(figure.axes, ERRORS, strict=True):
        values = factor * found.columns[name]
        mean, spread = np.nanmean(values, axis=0), np.nanstd(values, axis=0)
        probes = np.arange(len(mean))
        shade = np.maximum(mean - spread, 0.0), mean + spread
        axes.fill_between(probes, *shade, color=color, alpha=0.2, lw=0)
        axes.plot(probes, mean, color=color, lw=2)
        axes.set(xlabel="probe", xlim=(0, len(mean) - 1), ylim=(0.0, None))
        axes.set_title(label, loc="left")
        if name != "eps_k":
            inset = axes.inset_axes((0.42, 0.42, 0.56, 0.52))
            inset.semilogy(probes, mean, color=color)
            inset.tick_params(labelsize=8)
            inset.set_title("mean, log scale", size=8, loc="left")
    return figure


def postures(sets: dict[str, Set]) -> Figure:
    """Where the hand begins and ends, in adduction and in elevation of the approach axis."""
    figure = _figure(len(sets))
    for axes, (title, found) in zip(figure.axes, sets.items(), strict=True):
        _postures(axes, found)
        axes.set_title(title, loc="left")
        axes.label_outer()
    every = [axes.get_legend_handles_labels() for axes in figure.axes]
    named = {label: handle for pair in every for handle, label in zip(*pair, strict=True)}
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3)
    return figure


def _postures(axes: Axes, found: Set) -> None:
    adduction, elevation = found.columns["adduction_deg"], found.columns["elevation_deg"]
    end = found.ends
    begin = np.array([adduction[:, 0], elevation[:, 0]])
    axes.plot(*np.stack([begin, end]).transpose(1, 0, 2), color=INK, alpha=0.12, lw=0.8)
    axes.plot(*begin, ".", color=INK, ms=5, label="start")
    good = found.good
    axes.plot(*end[:, good], "o", mfc="none", color=END, ms=6, label="end")
    if not good.all():
        axes.plot(*end[:, ~good], "x", color=INK, ms=6, label="last touch of a trial that failed")
    axes.set(xlabel="adduction [°]", ylabel="elevation [°]", xlim=(0, 130), ylim=(20, 95))


def _figure(panels: int) -> Figure:
    figure = Figure(figsize=(3.5 * panels, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    figure.subplots(1, panels)
    return figure


def draw(sets: list[Set], out: Path, tail: str) -> None:
    """The figures into the folder `out`."""
    without, *composite = sets
    names = ("(a) cylinder, 5 cm", "(b) hexagon, sides of 6 cm", "(c) irregular, six sides")
    with_and_without = {
        r"without the kinematic law, $\Phi_{fm}$": without,
        r"with it, $\Phi_{fmk}$": composite[0],
    }
    with matplotlib.rc_context(STYLE):
        figures = {
            "3": figure_3(composite[0]),
            "4": postures(dict(zip(names, composite, strict=True))),
            "6": postures(with_and_without),
        }
        for number, figure in figures.items():
            path = out / f"figure-{number}{tail}.png"
            figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})


def write_data(sets: list[Set], path: Path) -> None:
    """Every number drawn: one row a trial and probe."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["object", "stack", "trial", "probe", *COLUMNS])
        for found in sets:
            shape = found.columns["eps_f"].shape
            for i, k in np.ndindex(*shape):
                values = [(form, found.columns[name][i, k]) for name, form in COLUMNS.items()]
                told = ["" if np.isnan(value) else form.format(value) for form, value in values]
                rows.writerow([found.scene, found.stack, i, k, *told])


def table(sets: list[Set]) -> str:
    """What the figures show, in numbers."""
    heads = ("adduction", "elevation", "along × across", "ε_k [rad]")
    lines = [f"{'':14}{'good':>5}  " + "".join(f"{head:>16}" for head in heads) + "  failures"]
    for found in sets:
        adduction, elevation = found.ends
        # Standard deviations along the line that fits the ends best, and across it.
        across, along = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(found.ends, ddof=0)), 0.0))
        angle = last(found.columns["eps_k"])
        cells = (
            f"{adduction.mean():.1f} ± {adduction.std():.1f}°",
            f"{elevation.mean():.1f} ± {elevation.std():.1f}°",
            f"{along:.1f} × {across:.1f}°",
            f"{angle.mean():.2f} ± {angle.std():.2f}",
        )
        count = Counter(found.verdicts)
        good = count.pop("good", 0)
        failures = ", ".join(f"{n} {kind}" for kind, n in count.items()) or "none"
        row = f"{f'{found.scene} {found.stack}':14}{good:>5}  "
        lines.append(row + "".join(f"{cell:>16}" for cell in cells) + f"  {failures}")
    return "\n".join(lines)


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
    sets = collect(Work(form, trials, probes, seed), jobs)
    out.mkdir(parents=True, exist_ok=True)
    data.mkdir(parents=True, exist_ok=True)
    tail = "" if form == "hierarchy" else f"-{form}"
    draw(sets, out, tail)
    write_data(sets, data / f"figures{tail}.csv")
    print(
        f"{trials} trials of {probes} probes each, seed {seed}, form {form}; postures at the end\n"
    )
    print(table(sets))
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu = sum(each.ru_utime + each.ru_stime for each in used)
    print(f"\n{time.perf_counter() - begin:.0f} s with {jobs} processes, {cpu:.0f} s of CPU")


if __name__ == "__main__":
    tyro.cli(main)
