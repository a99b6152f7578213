"""Many trials: in parallel, resumable, their records in one Parquet file."""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from hqp_grasp.errors import (
    InputError,
    ReachError,
    ResultsError,
    TrialError,
    WorkerError,
    flag,
    whole,
)
from hqp_grasp.experiments.executor import DEATHS, address_of, pickled, run_all, tell
from hqp_grasp.experiments.fingerprint import Fingerprint, cpu_kind, differences
from hqp_grasp.experiments.parts import Parts, sealed
from hqp_grasp.files import PART, digest, sweep, whole_file
from hqp_grasp.world.scene import Scene

STUDY_COLUMNS = {
    "trial": "number of the trial",
    "seed": "trial i draws from SeedSequence([seed, i])",
    "cpu": "kind of processor that ran the trial: bits are the same on one kind",
}


class Rows(Protocol):
    """What one trial brings."""

    def to_table(self) -> pa.Table:
        """Its rows, with a column `error`: what ended it, null where nothing did."""
        ...


@runtime_checkable
class Repeatable(Protocol):
    """What a study repeats: a value such as a Trial, whose rows are a pure function of a seed."""

    file: ClassVar[str]  # name of the file that all rows end in

    @property
    def scene(self) -> Scene:
        """Where it takes place."""
        ...

    def attempt(self, seed: Sequence[int]) -> Rows:
        """One trial; whatever ends it is told in its rows."""
        ...

    def nothing(self, seed: Sequence[int], error: str) -> Rows:
        """The rows of a trial of which nothing is known but what ended it: as many as of any."""
        ...


@dataclass(frozen=True)
class Study:
    """`trials` runs of one trial; trial i draws from SeedSequence([seed, i]).

    They run in `jobs` processes, or on the Dask `cluster` whose scheduler has this address, or
    wrote this file: workers return rows, this process writes them. DIR/parts/ holds finished
    trials, each written whole or not at all; DIR/probes.parquet, as `trial.file` says, is all
    of them. DIR/config.json
    says what was run: a folder is continued with the same configuration and refused with another,
    or where parts of it cannot be compared (see Fingerprint). Raises ResultsError, before any work,
    for a folder that cannot be written or continued; WorkerError where the workers cannot do the
    work or are gone: what is done is on disk.

    A trial that ends in an error keeps its rows so far, and says why in its column `error`; a rerun
    tries it again, and `trial.run((seed, i))` raises that error. One whose worker dies runs again,
    and has that for its error where it happens every time. With `strict` the study stops at the
    first one: what is done is on disk, then TrialError is raised. So does any study whose first
    trial finds no start (ReachError), unless one has worked in this folder before.
    """

    trial: Repeatable
    trials: int = 40
    seed: int = 0
    jobs: int = 1
    strict: bool = False
    cluster: str | Path | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.trial, Repeatable):
            raise InputError(
                f"Study.trial must be a Trial, or be repeated as one is; got {self.trial!r}"
            )
        for name, least in (("trials", 1), ("seed", 0), ("jobs", 1)):
            object.__setattr__(self, name, whole(name, getattr(self, name), least))
        object.__setattr__(self, "strict", flag("strict", self.strict))
        if self.cluster is not None:
            address_of(self.cluster)

    def configuration(self) -> dict[str, object]:
        """What fixes every figure of the study, timings aside; the number of trials does not."""
        found = Fingerprint(self.trial)
        return {"seed": self.seed, **found.parts, "unknown": found.unknown}

    def run(self, out: str | Path, columns: Sequence[str] | None = None) -> pa.Table:
        """Run what is missing or failed in `out`, and return the rows of these `trials`.

        All their columns, or these: 100,000 trials of 40 probes hold 2 GB. DIR/probes.parquet keeps
        further trials too, where the folder has them.
        """
        out, whole = Path(out), Path(out) / self.trial.file
        if self.jobs > 1 and self.trials > 1 and self.cluster is None:
            pickled(_Work(self.trial, self.seed))  # raises, before there is a folder
        configuration = self.configuration()
        like = _table(self.trial.nothing((self.seed, 0), "not run"), 0, self.seed)
        with _claimed(out, configuration) as folder:
            self.trial.scene.save(out / "scene.json")  # for whoever draws it
            parts = Parts(folder, like, digest(configuration))
            for name in parts.broken:
                tell(f"{folder / name} cannot be used: set aside, and what was in it runs again")
            failed = self._run_missing(parts, out)
            parts.merge(whole)
        if failed is not None:
            raise failed
        chosen = None if columns is None else list(columns)
        return pq.read_table(whole, columns=chosen, filters=[("trial", "<", self.trials)])

    def _run_missing(self, parts: Parts, out: Path) -> TrialError | None:
        """Run what is not done; return what ended a strict study, if anything did."""
        missing = [i for i in range(self.trials) if not parts.is_done(i)]
        bar = tqdm(total=self.trials, initial=self.trials - len(missing), unit="trial", ncols=80)
        work = _Work(self.trial, self.seed)
        begins = len(missing) < self.trials or self.trials == 1  # else the first trial shows it
        with bar, closing(run_all(work, missing, self.jobs, self.cluster)) as running:
            try:
                for i, table in running:
                    if table is None:
                        table = _table(self._died(i), i, self.seed)
                    parts.add(i, table)
                    bar.update()
                    error = table["error"][0].as_py()
                    begins = begins or not (error or "").startswith(ReachError.__name__)
                    told = f"trial {i} of seed {self.seed} ended by {error}"
                    if self.strict and error is not None:
                        return TrialError(told, i)
                    if not begins:
                        return TrialError(f"{told}; no other trial is run", i)
            except (WorkerError, ResultsError) as error:
                raise type(error)(
                    f"{error}; {len(parts)} trials are in {out}, and the same command continues"
                ) from error
        return None

    def _died(self, i: int) -> Rows:
        why = f"WorkerError: its process died each time, {DEATHS} times alone"
        return self.trial.nothing((self.seed, i), why)


@dataclass(frozen=True)
class _Work:
    """What workers do."""

    trial: Repeatable
    seed: int

    def __call__(self, i: int) -> pa.Table:
        return _run_one(self.trial, self.seed, i)


def _run_one(trial: Repeatable, seed: int, i: int) -> pa.Table:
    """The rows of trial i."""
    return _table(trial.attempt((seed, i)), i, seed)


def _table(rows: Rows, trial: int, seed: int) -> pa.Table:
    """The rows' table, and which trial of the study they are of."""
    table = rows.to_table()
    for at, (name, value) in enumerate({"trial": trial, "seed": seed, "cpu": cpu_kind()}.items()):
        kind = pa.string() if isinstance(value, str) else pa.int64()
        about = pa.field(name, kind, metadata={"meaning": STUDY_COLUMNS[name]})
        table = table.add_column(at, about, pa.array([value] * len(table), kind))
    return table


@contextmanager
def _claimed(out: Path, configuration: dict[str, object]) -> Iterator[Path]:
    """The parts folder of `out`, which can be written, is of this configuration, and only ours."""
    parts = out / "parts"
    try:
        parts.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=parts):
            pass
        held = os.open(parts, os.O_RDONLY)
    except OSError as error:
        raise ResultsError(f"{out} cannot be written: {error.strerror or error}") from error
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ResultsError(
                f"{out} is being written by another run; wait until it ends"
            ) from None
        except OSError as error:
            raise ResultsError(f"{parts} cannot be locked: {error.strerror or error}") from error
        _sweep(out, parts)
        _require_same(out, parts, configuration)
        yield parts
    finally:
        os.close(held)


def _sweep(out: Path, parts: Path) -> None:
    """Remove what runs left that died while they wrote."""
    try:
        sweep(out)
        # Nobody but us writes these, whatever lives under the number of who began them.
        for folder, names in ((parts, "*"), (out, "*.json.*"), (out, "*.parquet.*")):
            for left in folder.glob(f"{names}{PART}"):
                left.unlink(missing_ok=True)
    except OSError as error:
        raise ResultsError(f"{out} cannot be written: {error.strerror or error}") from error


def _require_same(out: Path, parts: Path, configuration: dict[str, object]) -> None:
    """Raise ResultsError unless what lies in `out`, if anything, is of this configuration."""
    config, of = out / "config.json", digest(configuration)
    if config.exists():
        there = _described(config)
        if there is not None:
            _compare(out, there, configuration)
            return
        # The parts say what they are of, too.
        if configuration["unknown"] or of not in map(_owner, parts.glob("*.parquet")):
            raise ResultsError(
                f"{config} cannot be read, was changed, or is of an older hqp_grasp, and no file "
                f"in {parts} says that it is of this configuration; take another --out"
            )
        config.replace(config.with_suffix(".broken"))
        tell(f"{config} cannot be read or was changed: set aside, and written again")
    elif any(parts.iterdir()):
        raise ResultsError(f"{out} holds results without a config.json; take another folder")
    with whole_file(config) as fresh:
        fresh.write_text(json.dumps(configuration | {"sha256": of.hex()}, indent=2) + "\n")


def _described(config: Path) -> dict[str, object] | None:
    """What a folder says that it holds; None where that is not what was written."""
    try:
        there = json.loads(config.read_text())
    except (ValueError, RecursionError):
        return None
    except OSError as error:
        raise ResultsError(f"{config} cannot be read: {error.strerror or error}") from error
    told = there.pop("sha256", None) if isinstance(there, dict) else None
    return there if told is not None and told == digest(there).hex() else None


def _owner(part: Path) -> bytes | None:
    """What configuration a part is of; None where it does not say, or is damaged."""
    try:
        return sealed(part)
    except ResultsError:
        return None


def _compare(out: Path, there: dict[str, object], here: dict[str, object]) -> None:
    """Raise ResultsError unless `out` can be continued."""
    way_out = "take another --out, or remove it"
    found = list(differences(there, json.loads(json.dumps(here))))
    if found:
        more = f", and {len(found) - 3} more" if len(found) > 3 else ""
        which = "; ".join(found[:3]) + more
        raise ResultsError(f"{out} belongs to another configuration: {which}; {way_out}")
    unknown = here["unknown"]
    if unknown:
        assert isinstance(unknown, list)
        raise ResultsError(
            f"{out} has results, and whether they are of this configuration cannot be told: "
            f"{unknown[0]}; {way_out}"
        )
