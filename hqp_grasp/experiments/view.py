"""A results folder in the browser: any trial, any probe, beside the same start of another study."""

from __future__ import annotations

import contextlib
import io
import json
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.fingerprint import Fingerprint
from hqp_grasp.experiments.parts import read_results
from hqp_grasp.experiments.plots import ANGLE, FLOOR, FORCE, MOMENT
from hqp_grasp.experiments.record import ALL_HAVE, SOME_HAVE, VERDICTS, holds, secures, verdicts
from hqp_grasp.experiments.replay import (
    Drawing,
    Frame,
    aim,
    camera,
    frames_of_rows,
    light,
    need_viser,
    placed,
)
from hqp_grasp.world.scene import Scene

HOST, PORT = "127.0.0.1", 8080  # this machine only
CURVES = (  # column, colour, what is plotted of it
    ("eps_f", FORCE, float),
    ("eps_m", MOMENT, lambda value: 1e3 * np.sqrt(value)),
    ("eps_k", ANGLE, float),
)
LABELS = ("ε_f [N²]", "√ε_m [mm·N]", "ε_k [rad]")
READ = ALL_HAVE | {"outcome": "texts", "eps_k": "numbers"}  # for verdicts, sliders and curves
LISTED = 24  # failures of a kind that get a button each
PLAY_SECONDS = 0.5  # a probe, while playing
SHOWN: Mapping[
    str, Callable[[Any], str]
] = {  # columns of a row and how they read, where the row has them
    "outcome": "{}".format,
    "eps_f": "{:.3e} N²".format,
    "eps_m": "{:.3e} (N·m)²".format,
    "eps_k": "{:.4f} rad".format,
    "eps_k_eq7": "{:.4f} m/rad".format,
    "friction_demand": holds,
    "friction_demand_true": holds,
    "adduction_deg": "{:.2f}°".format,
    "elevation_deg": "{:.2f}°".format,
    "step_share": "{:g}".format,
    "limit_active": "{}".format,
    "limit_violation": "{:g} rad".format,
    "hqp_projection_gap": "{:.1e} rad".format,
    "other_links": "{}".format,
    "method": "{}".format,
    "solve_us": "{:.0f} µs".format,
    "error": "{}".format,
}


@dataclass(frozen=True, eq=False)
class Results:
    """A results folder, read a trial at a time. Raises ResultsError where it cannot be shown."""

    folder: Path
    scene: Scene
    trials: int
    probes: int  # after the first touch, in each trial
    seed: int
    failures: Mapping[str, tuple[int, ...]]  # trials by VERDICTS, those that are not good
    secure: int | None  # trials that end secure; None in a folder from before friction demands
    same_scene: bool  # False where the robot's files or MuJoCo are not those of the study

    @classmethod
    def open(cls, folder: str | Path) -> Results:
        """Read what is needed to choose a trial."""
        folder = Path(folder)
        if not folder.is_dir():
            raise ResultsError(f"there is no folder {folder}")
        for name in ("probes.parquet", "scene.json", "config.json"):
            if not (folder / name).is_file():
                raise ResultsError(
                    f"{folder} has no {name}; the command that made this folder, run again, "
                    "completes it"
                )
        scene = Scene.load(folder / "scene.json")
        try:
            there = json.loads((folder / "config.json").read_text())["trial"]["scene"]
            needed = READ | {f"q_{joint}": "numbers" for joint in scene.articulated.joints}
            table = read_results(folder / "probes.parquet", needed, SOME_HAVE)
        except (ResultsError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise ResultsError(f"{folder} cannot be read: {error}") from error
        verdict = verdicts(table)
        secure = sum(secures(table).values()) if "friction_demand" in table.column_names else None
        trials, probes = (int(pc.max(table[name]).as_py()) for name in ("trial", "probe"))
        seed = int(table["seed"][0].as_py())
        here = json.loads(json.dumps(Fingerprint(scene).parts["trial"]))
        failures = {
            kind: tuple(trial for trial, found in sorted(verdict.items()) if found == kind)
            for kind in VERDICTS
            if kind != "good"
        }
        return cls(folder, scene, trials + 1, probes, seed, failures, secure, there == here)

    def rows(self, trial: int) -> list[dict[str, Any]]:
        """The rows of one trial, in order."""
        path = self.folder / "probes.parquet"
        return pq.read_table(path, filters=[("trial", "=", trial)]).to_pylist()


# ---------------------------------------------------------------- the page

_Loaded = tuple[Scene, list[Frame], list[dict[str, Any]]]  # no frames where it never touched


class Viewer:
    """Scene, controls, plot and numbers on a viser server; see `serve`."""

    def __init__(self, server: Any, results: Results, other: Results | None = None) -> None:
        self._results, self._other = results, other
        self._lock = threading.RLock()  # controls call back from several threads
        self._load = lru_cache(maxsize=8)(_load)
        light(server.scene)
        scene, first, _ = self._load(results, 0)
        view = camera(scene, first[0].q if first else scene.articulated.home)
        aim(server, view, aside=0.55, distance=2.8)  # the controls cover the right
        self._drawing = Drawing(server.scene, results.scene, "/hand")
        self._ghost = None
        if other is not None:
            self._ghost = Drawing(server.scene, other.scene, "/ghost", ghost=True)
        gui = server.gui
        gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
        gui.set_panel_label(f"hqp_grasp: {results.folder.name}")
        gui.add_markdown(self._heading())
        # A slider needs two ends, even where there is one trial.
        self._trial = gui.add_slider("trial", 0, max(1, results.trials - 1), 1, 0)
        self._probe = gui.add_slider("probe", 0, max(1, results.probes), 1, 0)
        self._play = gui.add_checkbox("play", initial_value=False)
        self._list_failures(gui)
        self._plot = gui.add_uplot(
            self._curves(0, 0),
            self._series(),
            title="log₁₀ of the errors over probes",
            scales={"x": {"time": False}, "shown": {"range": (0.0, 1.0)}},
            height=220,
        )
        self._numbers = gui.add_markdown("")
        self._trial.on_update(lambda _: self.refresh())
        self._probe.on_update(lambda _: self.refresh())
        self.refresh()

    def refresh(self) -> None:
        """Draw and write what the controls say."""
        with self._lock:
            trial = min(self._trial.value, self._results.trials - 1)
            probe = min(self._probe.value, self._results.probes)
            columns = [(self._results, self._draw(self._drawing, self._results, trial, probe))]
            if self._other is not None and self._ghost is not None:
                row = self._draw(self._ghost, self._other, trial, probe)
                columns.append((self._other, row))
            self._numbers.content = _numbers(trial, probe, columns)
            self._plot.data = self._curves(trial, probe)

    def show(self, trial: int) -> None:
        """Go to the end of a trial: its last probe, or the one after which it was given up."""
        rows = self._load(self._results, trial)[2]
        self._trial.value = trial
        self._probe.value = max((row["probe"] for row in rows if row["outcome"]), default=0)

    def play(self) -> None:
        """Step through the probes while `play` is ticked; never returns."""
        while True:
            time.sleep(PLAY_SECONDS)
            if self._play.value:
                self._probe.value = (self._probe.value + 1) % (self._results.probes + 1)

    def _draw(
        self, drawing: Drawing, results: Results, trial: int, probe: int
    ) -> dict[str, Any] | None:
        """Put one robot where it was; return the row, None where this study has no such probe."""
        scene, frames, rows = self._load(results, trial)
        drawing.visible = bool(frames) and probe < len(frames)
        if drawing.visible:
            drawing.show(scene.articulated, frames, probe)
        return rows[probe] if probe < len(rows) else None

    def _curves(self, trial: int, probe: int) -> tuple[np.ndarray, ...]:
        """Probes, then log₁₀ of each error of each study, then the shown probe by itself."""
        length = self._results.probes + 1
        curves = [np.arange(length, dtype=float)]
        for results in filter(None, (self._results, self._other)):
            rows = self._load(results, trial)[2]
            for name, _, scale in CURVES:
                values = np.full(length, np.nan)
                for i, row in enumerate(rows[:length]):
                    if row[name] is not None:
                        values[i] = np.log10(max(scale(row[name]), FLOOR))
                curves.append(values)
        now = np.full(length, np.nan)
        now[probe] = 0.0
        curves.append(now)
        return tuple(curves)

    def _series(self) -> tuple[Mapping[str, Any], ...]:
        series: list[Mapping[str, Any]] = [{"label": "probe"}]
        for results in filter(None, (self._results, self._other)):
            ghost = results is self._other
            for label, (_, colour, _) in zip(LABELS, CURVES, strict=True):
                line = {"label": f"{label}{' (ghost)' if ghost else ''}", "stroke": colour}
                series.append(line | {"width": 1 if ghost else 2, "dash": [4, 4] if ghost else []})
        shown = {"show": True, "size": 12, "fill": "black"}
        now = {"label": "shown", "scale": "shown", "stroke": "black", "points": shown}
        return (*series, now)

    def _heading(self) -> str:
        results = self._results
        bad = sum(map(len, results.failures.values()))
        lines = [
            f"**{results.folder}**: {results.trials} trials of {results.probes} probes, "
            f"{results.trials - bad} good, "
            + ("" if results.secure is None else f"{results.secure} secure, ")
            + f"seed {results.seed}"
        ]
        if self._other is not None:
            lines.append(f"ghost: **{self._other.folder}**, the same starts")
        for each in filter(None, (results, self._other)):
            if not each.same_scene:
                lines.append(
                    f"{each.folder}: robot or MuJoCo have changed since; "
                    "what is drawn is the robot of today"
                )
        return "\n\n".join(lines)

    def _list_failures(self, gui: Any) -> None:
        """A button for each failure, by kind."""
        for kind, trials in self._results.failures.items():
            if not trials:
                continue
            label = f"{kind}: {len(trials)}"
            label += f", the first {LISTED}" if len(trials) > LISTED else ""
            group = gui.add_button_group(label, [str(trial) for trial in trials[:LISTED]])
            group.on_click(lambda event: self.show(int(event.target.value)))


def _load(results: Results, trial: int) -> _Loaded:
    rows = results.rows(trial)
    if not any(row["in_contact"] for row in rows):
        return results.scene, [], rows
    frames = frames_of_rows(rows, results.scene.articulated.joints)
    return placed(results.scene, frames), frames, rows


def _numbers(
    trial: int, probe: int, columns: Sequence[tuple[Results, dict[str, Any] | None]]
) -> str:
    """The rows shown, one column a study, as a table."""
    head = "|".join(
        f"{results.folder.name}{' (ghost)' if i else ''}" for i, (results, _) in enumerate(columns)
    )
    lines = [f"| trial {trial}, probe {probe} |{head}|", "|---|" + "---|" * len(columns)]
    for name, said in SHOWN.items():
        values = [None if row is None else row.get(name) for _, row in columns]
        if any(value not in (None, "") for value in values):
            cells = "|".join("–" if v in (None, "") else said(v) for v in values)
            lines.append(f"| {name} |{cells}|")
    return "\n".join(lines)


# ---------------------------------------------------------------- the command


def serve(
    folder: str | Path,
    compare: str | Path | None = None,
    trial: int | None = None,
    host: str = HOST,
    port: int = PORT,
) -> None:
    """Show a results folder in the browser until interrupted, `trial` at its end first."""
    results = Results.open(folder)
    viser = need_viser()
    if trial is not None and not 0 <= trial < results.trials:
        raise InputError(f"{folder} has trials 0 … {results.trials - 1}; got {trial}")
    other = None if compare is None else Results.open(compare)
    if other is not None and other.seed != results.seed:
        raise InputError(
            f"{results.folder} has seed {results.seed}, {other.folder} has {other.seed}: "
            "a ghost needs the same starts"
        )
    _require_free(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # viser's banner; ours says the same
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        viewer = Viewer(server, results, other)
        if trial is not None:
            viewer.show(trial)
        print(f"{results.folder} at http://{host}:{server.get_port()}; Ctrl-C ends", flush=True)
        viewer.play()
    except KeyboardInterrupt:
        print()
    finally:
        server.stop()


def _require_free(host: str, port: int) -> None:
    """viser would take the next free port without a word."""
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        raise InputError(
            f"cannot listen on {host}:{port}: {error.strerror or error}; "
            "choose another with --port, 0 for any free one"
        ) from error
