"""Cells of trials in, tallies out: what benchmarks over random starts have in common.

Trial i begins alike in every cell, so that cells compare in pairs. A grid is a study like any
other: it shows progress, runs in processes or on a cluster, and goes on in its folder `--out` where
it was interrupted, or with more trials.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, ClassVar

import numpy as np
import pyarrow as pa
import tyro
from hqp_grasp.scenarios import cylinder, cylinder_65, hexagon, irregular

import hqp_grasp as hg
from hqp_grasp.experiments.report import interval
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.table import table_of

SCENES = {
    "cylinder": cylinder.scene,
    "cylinder_65": cylinder_65.scene,
    "hexagon": hexagon.scene,
    "irregular": irregular.scene,
}
COLUMNS = {
    "cell": "text: which of the grid",
    "verdict": "text: what became of the trial",
    "probe": "count: from which it stays balanced, to the end",
    "secure": "bool: a friction of 0.2 holds the grasp at the end",
    "why": "text: why it is not balanced, or what its last miss was",
    "error": "text: what ended it",
}

Figures = Callable[
    [str, hg.Trial, hg.Record], dict[str, float]
]  # of a trial of a cell, also where it felt nothing


@dataclass(frozen=True)
class End:
    """What became of one trial."""

    verdict: str
    probe: int | None  # from which it stays balanced
    secure: bool
    why: str
    figures: dict[str, float]  # NaN: there is none


@dataclass(frozen=True)
class Runs:
    """How many trials, of which seed, and where they run."""

    trials: Annotated[int, tyro.conf.arg(aliases=("--starts",))] = 20
    """Random starts, the same for every cell."""
    seed: int = 0
    """Trial i draws from SeedSequence([seed, i])."""
    jobs: int = 2
    """Processes."""
    out: Path | None = None
    """Folder to keep results in, and to go on in; none: they are printed only."""
    cluster: str | None = None
    """Run on a Dask cluster instead: the address of its scheduler."""

    def of(
        self, cells: Mapping[str, hg.Trial], figures: Figures | None = None, apart: bool = False
    ) -> dict[str, list[End]]:
        """The ends of each cell's trials; with `apart`, trial i of cell c is of (seed, c, i)."""
        grid = Grid(tuple(cells.items()), figures, apart)
        study = Study(grid, self.trials * len(cells), self.seed, self.jobs, cluster=self.cluster)
        with TemporaryDirectory() as folder:
            rows = study.run(self.out or folder).sort_by("trial").to_pylist()
        own = [name for name in rows[0] if name not in {*COLUMNS, "trial", "seed", "cpu"}]
        ends: dict[str, list[End]] = {name: [] for name in cells}
        for row in rows:
            found = {name: np.nan if row[name] is None else row[name] for name in own}
            told = [row[name] for name in ("verdict", "probe", "secure")]
            ends[row["cell"]].append(End(*told, row["error"] or row["why"] or "", found))
        return ends

    def __str__(self) -> str:
        return f"{self.trials} starts of seed {self.seed}"


@dataclass(frozen=True)
class Grid:
    """Trials of a study, each cell in turn; one row a trial."""

    file: ClassVar[str] = "ends.parquet"
    cells: tuple[tuple[str, hg.Trial], ...]
    figures: Figures | None
    apart: bool

    @property
    def scene(self) -> hg.Scene:
        """Of the first cell."""
        return self.cells[0][1].scene

    def attempt(self, seed: Sequence[int]) -> Row:
        """Trial number seed[-1] of all cells."""
        i, cell = divmod(seed[-1], len(self.cells))
        name, trial = self.cells[cell]
        record = trial.attempt((*seed[:-1], *((cell,) if self.apart else ()), i))
        missed = [str(told) for told in record.column("outcome") if told not in (None, "touch")]
        why = record.unbalanced or (missed[-1] if missed and record.lost else None)
        row = Row(
            {
                "cell": name,
                "verdict": record.verdict,
                "probe": record.converged_at,
                "secure": record.secure,
                "why": why,
                "error": record.error,
            }
        )
        return replace(row, figures=self.figures(name, trial, record)) if self.figures else row

    def nothing(self, seed: Sequence[int], error: str) -> Row:
        """A trial of which nothing is known."""
        i, cell = divmod(seed[-1], len(self.cells))
        name, trial = self.cells[cell]
        row = Row({"cell": name, "verdict": "error", "secure": False, "error": error})
        nothing = trial.nothing((i,), error)
        return replace(row, figures=self.figures(name, trial, nothing)) if self.figures else row


@dataclass(frozen=True)
class Row:
    """One row of COLUMNS, and a grid's own figures."""

    about: Mapping[str, object]
    figures: Mapping[str, float] | None = None

    def to_table(self) -> pa.Table:
        """As a table."""
        own = self.figures or {}
        return table_of([{**self.about, **own}], COLUMNS | dict.fromkeys(own, "a figure"))


def table(found: Mapping[str, Sequence[End]], *own: str) -> str:
    """One row a cell: shares, probes until balanced, the median of each own figure, failures."""
    wide = max(map(len, found))
    widths = {head: max(len(head) + 2, 10) for head in own}
    told = "".join(f"{head:>{width}}" for head, width in widths.items())
    heads = f"{'good [95 %]':>24}{'secure':>8}{'median':>8}{'p99':>5}{'worst':>7}{told}  failures"
    rows = [f"{'':{wide}}{heads}"]
    for name, ends in found.items():
        kinds = Counter(end.verdict for end in ends)
        good = kinds.pop("good", 0)
        low, high = interval(good, len(ends))
        at = [end.probe for end in ends if end.probe is not None]
        probes = f"{'–':>8}{'–':>5}{'–':>7}"
        if at:
            probes = f"{np.median(at):8g}{np.percentile(at, 99):5.0f}{max(at):7}"
        figures = ""
        for head, width in widths.items():
            values = np.array([end.figures[head] for end in ends])
            known = values[~np.isnan(values)]
            figures += f"{f'{np.median(known):.3g}' if len(known) else '–':>{width}}"
        share = f"{good} of {len(ends)} [{low:.0%}, {high:.0%}]"
        secure = sum(end.secure for end in ends)
        failures = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        rows.append(f"{name:{wide}}{share:>24}{secure:8}{probes}{figures}  {failures}".rstrip())
    return "\n".join(rows)


def command(main: Callable[..., None]) -> None:
    """Run a benchmark's main by its command line; what is wrong is said in one line."""
    try:
        tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))
    except hg.HqpGraspError as error:
        sys.exit(f"{Path(sys.argv[0]).stem}: {error}")
