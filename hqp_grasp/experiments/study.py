"""Many trials: in parallel, resumable, their records in one Parquet file."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Generator, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from hqp_grasp.errors import InputError, ResultsError, TrialError
from hqp_grasp.experiments.fingerprint import Fingerprint, differences
from hqp_grasp.experiments.record import Record
from hqp_grasp.experiments.trial import Trial

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


STUDY_COLUMNS = {
    "trial": "number of the trial",
    "seed": "trial i draws from SeedSequence([seed, i])",
}


@dataclass(frozen=True)
class Study:
    """`trials` runs of one trial; trial i draws from SeedSequence([seed, i]).

    DIR/parts/ holds one file a trial, written whole or not at all; DIR/probes.parquet is all of
    them. DIR/config.json says what was run: a folder is continued with the same configuration and
    refused with another, or where parts of it cannot be compared (see Fingerprint). Raises
    ResultsError, before any work, for a folder that cannot be written or continued.

    A trial that ends in an error keeps its rows so far, and says why in its column `error`; a rerun
    tries it again, and `trial.run((seed, i))` raises that error. With `strict` the study stops at
    the first one: what is done is on disk, then TrialError is raised.
    """

    trial: Trial
    trials: int = 40
    seed: int = 0
    jobs: int = 1
    strict: bool = False

    def __post_init__(self) -> None:
        for name, least in (("trials", 1), ("seed", 0), ("jobs", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}; got {getattr(self, name)}")

    def configuration(self) -> dict[str, object]:
        """What fixes every figure of the study, timings aside; the number of trials does not."""
        found = Fingerprint(self.trial)
        return {"seed": self.seed, **found.parts, "unknown": found.unknown}

    def run(self, out: str | Path) -> pa.Table:
        """Run what is missing or failed in `out`, and return the rows of these `trials`.

        DIR/probes.parquet keeps further trials too, where the folder has them.
        """
        out = Path(out)
        parts = _claim(out, self.configuration())
        self.trial.scene.save(out / "scene.json")  # for whoever draws it
        missing = [i for i in range(self.trials) if not _is_done(_part(parts, i))]
        bar = tqdm(total=self.trials, initial=self.trials - len(missing), unit="trial", ncols=80)
        failed: TrialError | None = None
        with bar, closing(self._run_missing(missing, parts)) as running:
            for i, error in running:
                bar.update()
                if self.strict and error is not None:
                    failed = TrialError(f"trial {i} of seed {self.seed} ended by {error}", i)
                    break
        table = _merge(parts, out / "probes.parquet")
        if failed is not None:
            raise failed
        numbers = table.column("trial").to_numpy()
        return table.filter(pa.array(numbers < self.trials))

    def _run_missing(
        self, missing: list[int], parts: Path
    ) -> Generator[tuple[int, str | None], None, None]:
        """Run these; yield each one's number, and what ended it."""
        if self.jobs == 1 or len(missing) < 2:
            for i in missing:
                yield i, _run_one(self.trial, self.seed, i, parts)
            return
        with (
            _one_blas_thread(),
            ProcessPoolExecutor(self.jobs, mp_context=get_context("spawn")) as pool,
        ):
            futures = {pool.submit(_run_one, self.trial, self.seed, i, parts): i for i in missing}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise


def _run_one(trial: Trial, seed: int, i: int, parts: Path) -> str | None:
    """Run trial i and write it down; return what ended it, if anything did."""
    record = trial.attempt((seed, i))
    _write(_table(record, i, seed), _part(parts, i))
    return record.error


def _table(record: Record, trial: int, seed: int) -> pa.Table:
    """The record's table, and which trial of the study it is."""
    table = record.to_table()
    for at, (name, value) in enumerate({"trial": trial, "seed": seed}.items()):
        about = pa.field(name, pa.int64(), metadata={"meaning": STUDY_COLUMNS[name]})
        table = table.add_column(at, about, pa.array([value] * len(record.rows), pa.int64()))
    return table


def _is_done(part: Path) -> bool:
    """True where the trial has run, and no error ended it."""
    return part.exists() and pq.read_table(part, columns=["error"])["error"].null_count > 0


def _merge(parts: Path, whole: Path) -> pa.Table:
    """All trials of the folder, in order."""
    table = pa.concat_tables([pq.read_table(part) for part in sorted(parts.glob("*.parquet"))])
    _write(table, whole)
    return table


def _part(parts: Path, i: int) -> Path:
    return parts / f"trial_{i:06d}.parquet"


def _write(table: pa.Table, path: Path) -> None:
    """Write the whole file, or nothing."""
    part = path.with_suffix(f".{os.getpid()}.part")
    pq.write_table(table, part)
    part.replace(path)


def _claim(out: Path, configuration: dict[str, object]) -> Path:
    """Make sure that `out` can be written and is ours; return its parts folder."""
    parts = out / "parts"
    try:
        parts.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=parts):
            pass
    except OSError as error:
        raise ResultsError(f"{out} cannot be written: {error.strerror or error}") from error
    config = out / "config.json"
    if config.exists():
        _compare(out, json.loads(config.read_text()), configuration)
    elif any(parts.iterdir()):
        raise ResultsError(f"{out} holds results without a config.json; take another folder")
    else:
        fresh = config.with_suffix(f".{os.getpid()}.part")
        fresh.write_text(json.dumps(configuration, indent=2) + "\n")
        fresh.replace(config)
    return parts


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


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Workers inherit the environment: one thread each, so that they do not crowd the cores."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
