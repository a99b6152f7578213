"""Many trials: in parallel, resumable, their records in one Parquet file."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.record import Record
from hqp_grasp.experiments.trial import Trial

VERSIONS = ("hqp_grasp", "numpy", "mujoco", "proxsuite", "daqp", "mink")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Study:
    """`trials` runs of one trial; trial i draws from SeedSequence([seed, i]).

    DIR/parts/ holds one file a trial, written whole or not at all; they are merged into
    DIR/probes.parquet. DIR/config.json says what was run: a folder is continued with the same
    configuration and refused with another. Raises ResultsError, before any work, for a folder
    that cannot be written or belongs to another configuration.
    """

    trial: Trial
    trials: int = 40
    seed: int = 0
    jobs: int = 1

    def __post_init__(self) -> None:
        for name, least in (("trials", 1), ("seed", 0), ("jobs", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}; got {getattr(self, name)}")

    def configuration(self) -> dict[str, object]:
        """What fixes every figure of the study, timings aside; the number of trials does not."""
        return {
            "trial": repr(self.trial),
            "model": self.trial.scene.fingerprint(),
            "seed": self.seed,
            "versions": {package: version(package) for package in VERSIONS},
        }

    def run(self, out: Path) -> pa.Table:
        """Run what is missing in `out`, merge, and return the table of all `trials`."""
        parts = _claim(out, self.configuration())
        missing = [i for i in range(self.trials) if not _part(parts, i).exists()]
        bar = tqdm(total=self.trials, initial=self.trials - len(missing), unit="trial", ncols=80)
        with bar:
            for _ in self._run_missing(missing, parts):
                bar.update()
        table = pa.concat_tables([pq.read_table(_part(parts, i)) for i in range(self.trials)])
        _write(table, out / "probes.parquet")
        return table

    def _run_missing(self, missing: list[int], parts: Path) -> Iterator[None]:
        if self.jobs == 1 or len(missing) < 2:
            for i in missing:
                _run_one(self.trial, self.seed, i, parts)
                yield
            return
        with (
            _one_blas_thread(),
            ProcessPoolExecutor(self.jobs, mp_context=get_context("spawn")) as pool,
        ):
            futures = [pool.submit(_run_one, self.trial, self.seed, i, parts) for i in missing]
            try:
                for future in as_completed(futures):
                    yield future.result()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise


def _run_one(trial: Trial, seed: int, i: int, parts: Path) -> None:
    _write(_table(trial.run((seed, i)), i, seed), _part(parts, i))


def _table(record: Record, trial: int, seed: int) -> pa.Table:
    """The record's table, and which trial of the study it is."""
    table = record.to_table()
    meanings = {
        "trial": "number of the trial",
        "seed": "trial i draws from SeedSequence([seed, i])",
    }
    for at, (name, value) in enumerate({"trial": trial, "seed": seed}.items()):
        field = pa.field(name, pa.int64(), metadata={"meaning": meanings[name]})
        table = table.add_column(at, field, pa.array([value] * len(record.rows), pa.int64()))
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
    text = json.dumps(configuration, indent=2) + "\n"
    if not config.exists():
        if any(parts.iterdir()):
            raise ResultsError(f"{out} holds results without a config.json; take another folder")
        fresh = config.with_suffix(f".{os.getpid()}.part")
        fresh.write_text(text)
        fresh.replace(config)
    elif config.read_text() != text:
        raise ResultsError(
            f"{out} belongs to another configuration ({config}); take another --out, or remove it"
        )
    return parts


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
