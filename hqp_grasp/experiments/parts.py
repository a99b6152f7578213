"""The finished trials of a results folder on disk: each written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import groupby
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hqp_grasp.files import whole_file

BATCH = 500  # trials in a file of several
OPEN = 4  # files of several trials held in memory while merging


class Parts:
    """The trials in a folder: the latest files of single trials, the others in batches of BATCH.

    A trial is first written to trial_000123.parquet. BATCH of these then become one
    batch_000001.parquet, and go. A trial that ran again stands in several files: its own wins over
    batches, a later batch over an earlier one. Every file appears by rename, complete.

    A file that cannot be read is set aside, as .broken, and named in `broken`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._where: dict[int, Path] = {}  # the file of each trial
        self._failed: set[int] = set()
        self._single: dict[int, pa.Table] = {}  # not yet in a batch
        self.broken: list[str] = []
        batches = sorted(folder.glob("batch_*.parquet"))
        self._batches = 1 + max((int(path.stem.partition("_")[2]) for path in batches), default=-1)
        for path in [*batches, *sorted(folder.glob("trial_*.parquet"))]:
            self._find(path)
        for path in set(batches) - set(self._where.values()):
            path.unlink(missing_ok=True)  # every trial in it has run again
        if len(self._single) >= BATCH:
            self._compact()

    def _find(self, path: Path) -> None:
        """Take down which trials are in a file, or set it aside."""
        try:
            self._note(path, _read(path))
        except (pa.ArrowException, OSError, KeyError) as error:
            if isinstance(error, PermissionError):
                raise
            path.replace(path.with_suffix(".broken"))
            self.broken.append(f"{path.name} ({' '.join(str(error).split())[:80]})")

    def _note(self, path: Path, table: pa.Table) -> None:
        trials = table["trial"].unique().to_pylist()
        failed = table.filter(pc.is_valid(table["error"]))["trial"].unique().to_pylist()
        self._where.update(dict.fromkeys(trials, path))
        self._failed.difference_update(trials)
        self._failed.update(failed)
        if path.name.startswith("trial_"):
            self._single.update(dict.fromkeys(trials, table))

    def __len__(self) -> int:
        return len(self._where)

    def is_done(self, trial: int) -> bool:
        """True where the trial has run, and no error ended it."""
        return trial in self._where and trial not in self._failed

    def add(self, trial: int, table: pa.Table) -> None:
        """Write one trial."""
        path = self._folder / f"trial_{trial:06d}.parquet"
        _write([table], path)
        self._note(path, table)
        if len(self._single) >= BATCH:
            self._compact()

    def merge(self, whole: Path) -> None:
        """Write all trials, in order, into one file."""
        _write(self._in_order(), whole, keep=True)

    def _compact(self) -> None:
        """Make one file of the single ones."""
        batch = self._folder / f"batch_{self._batches:06d}.parquet"
        trials = sorted(self._single)
        _write([pa.concat_tables([self._single[i] for i in trials])], batch, keep=True)
        self._batches += 1
        for i in trials:
            self._where[i].unlink()
            self._where[i] = batch
        self._single.clear()

    def _in_order(self) -> Iterator[pa.Table]:
        """The rows by trial, BATCH trials at a time."""
        read = lru_cache(maxsize=OPEN)(_read)
        waiting: list[pa.Table] = []
        trials = 0
        for path, run in groupby(sorted(self._where), key=self._where.__getitem__):
            numbers = list(run)
            if path.name.startswith("trial_"):
                waiting.append(self._single[numbers[0]])
            else:
                table = read(path)
                column = table["trial"].to_numpy()
                begin = int(np.searchsorted(column, numbers[0], "left"))
                end = int(np.searchsorted(column, numbers[-1], "right"))
                waiting.append(table.slice(begin, end - begin))
            trials += len(numbers)
            if trials >= BATCH:
                yield pa.concat_tables(waiting)
                waiting, trials = [], 0
        if waiting:
            yield pa.concat_tables(waiting)


def _read(path: Path) -> pa.Table:
    return pq.ParquetFile(path, page_checksum_verification=True).read()


def _write(tables: Iterable[pa.Table], path: Path, keep: bool = False) -> None:
    """Write the whole file, a row group a table, or nothing; what is to stay, small and safely."""
    tables = iter(tables)
    first = next(tables)
    packing = "zstd" if keep else "snappy"
    with whole_file(path) as part:
        with pq.ParquetWriter(
            part, first.schema, compression=packing, write_page_checksum=True
        ) as file:
            file.write_table(first)
            for table in tables:
                file.write_table(table)
        if keep:
            with part.open("rb") as written:
                os.fsync(written.fileno())
