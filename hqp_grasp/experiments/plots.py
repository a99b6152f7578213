"""The figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hqp_grasp.errors import ResultsError
from hqp_grasp.experiments.record import CONVERGED_FORCE, CONVERGED_MOMENT
from hqp_grasp.files import whole_file

FORCE, MOMENT, ANGLE = "#0072b2", "#d55e00", "#009e73"
FLOOR = 1e-16  # errors below are drawn here


def convergence(table: pa.Table, title: str, path: Path) -> None:
    """Draw `convergence_figure` into the file `path`, whole or not at all."""
    with whole_file(path) as part:
        convergence_figure(table, title).savefig(part, dpi=130, format="png")


def convergence_figure(table: pa.Table, title: str) -> Figure:
    """The three errors over the probes, and where the hand began and ended (Figures 3 and 4)."""
    force, moment, angle, adduction, elevation = (
        _by_trial(table, name)
        for name in ("eps_f", "eps_m", "eps_k", "adduction_deg", "elevation_deg")
    )
    figure = Figure(figsize=(13, 4), layout="constrained")
    FigureCanvasAgg(figure)  # a canvas of its own: no display, and nobody's backend is touched
    left, middle, right = figure.subplots(1, 3)
    _spread(left, force, FORCE, r"$\varepsilon_f$ [N²]")
    _spread(left, 1e3 * np.sqrt(moment), MOMENT, r"$\sqrt{\varepsilon_m}$ [mm·N]")
    left.axhline(CONVERGED_FORCE, color=FORCE, ls=":", lw=1)
    left.axhline(1e3 * CONVERGED_MOMENT, color=MOMENT, ls=":", lw=1)
    left.set(yscale="log", xlabel="probe", title="net force and moment")
    left.legend()
    _spread(middle, angle, ANGLE, "")
    middle.set(xlabel="probe", ylabel=r"$\varepsilon_k$ [rad]", ylim=(0.0, None))
    middle.set_title("angle between flexion and normal")
    right.plot(adduction[:, 0], elevation[:, 0], "k.", label="start")
    right.plot(_last(adduction), _last(elevation), "o", mfc="none", color=MOMENT, label="end")
    right.set(xlabel="adduction [°]", ylabel="elevation [°]", title="posture of the hand")
    right.legend()
    figure.suptitle(title)
    return figure


def _by_trial(table: pa.Table, name: str) -> np.ndarray:
    """One column as (trials, probes), NaN where missing."""
    trials = len(table.column("trial").unique())
    return table.column(name).to_numpy().astype(float).reshape(trials, -1)


def _last(values: np.ndarray) -> list[float]:
    """The last number of each trial, NaN where it has none: not every robot has an adduction."""
    return [next((v for v in reversed(row) if np.isfinite(v)), np.nan) for row in values]


def _spread(axes: Axes, values: np.ndarray, color: str, label: str) -> None:
    """Median, and the range of all trials around it."""
    probes = np.arange(values.shape[1])
    some = np.isfinite(values).any(axis=0)
    shown = np.maximum(values[:, some], FLOOR)
    axes.fill_between(
        probes[some], np.nanmin(shown, axis=0), np.nanmax(shown, axis=0), color=color, alpha=0.2
    )
    axes.plot(probes[some], np.nanmedian(shown, axis=0), color=color, label=label)


def picked(looks: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Draw `picked_figure` into the file `path`. Raises ResultsError where nothing was lifted."""
    if not looks:
        raise ResultsError("nothing was held, so there is nothing to draw")
    with whole_file(path) as part:
        picked_figure(looks, title).savefig(part, dpi=130, format="png")


def picked_figure(looks: Sequence[Mapping[str, Any]], title: str) -> Figure:
    """The contacts' normal forces and the load over time, the phases of a pick in the background.

    `looks` are rows with the fields of `experiments.pick.LOOK`.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    time = np.array([look["time"] for look in looks]) - looks[0]["time"]
    k = max(len(look["normal"]) for look in looks)
    normal = np.array([look["normal"] or [np.nan] * k for look in looks]).reshape(len(looks), k)
    for i in range(k):
        axes.plot(time, normal[:, i], lw=1, label=f"normal force, contact {i + 1}")
    axes.plot(time, [look["strength"] for look in looks], "k:", label="asked for in the mean")
    axes.plot(time, [look["load"] for look in looks], color=MOMENT, lw=2, label="load")
    phases = [look["phase"] for look in looks]
    begins = [i for i in range(len(looks)) if i == 0 or phases[i] != phases[i - 1]]
    ends = [*(time[i] for i in begins[1:]), time[-1]]
    for n, (i, end) in enumerate(zip(begins, ends, strict=True)):
        axes.axvspan(time[i], end, color="0.5", alpha=0.08 if n % 2 else 0.2, lw=0)
        at = (0.5 * (time[i] + end), 1.01)
        axes.text(*at, phases[i], transform=axes.get_xaxis_transform(), ha="center", fontsize=8)
    axes.set(xlabel="time [s]", ylabel="force [N]")
    axes.legend(fontsize=8)
    figure.suptitle(title)
    return figure
