"""The finished trials of a results folder on disk: each written whole or not at all."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hqp_grasp.errors import ResultsError
from hqp_grasp.files import whole_file

T = TypeVar("T")
BATCH = 500  # trials in a file of several
OPEN = 4  # files of several trials held in memory while merging
NAME = re.compile(r"(trial|batch)_([0-9]{6,})\.parquet")
# A seal stands between the rows and the footer of a Parquet file, where no reader looks: the mark,
# the digest of the configuration that the rows are of, and that of all else in the file.
MARK = b"hqp_grasp sha256"
DIGEST = hashlib.sha256().digest_size
SEAL = len(MARK) + 2 * DIGEST


class Parts:
    """The trials in a folder: the latest files of single trials, the others in batches of BATCH.

    A trial is first written to trial_000123.parquet. BATCH of these then become one
    batch_000001.parquet, and go. A trial that ran again stands in several files: its own wins over
    batches, a later batch over an earlier one. Every file appears by rename, complete, sealed with
    `of`, the digest of the study's configuration.

    `like` is the table of any trial of the study: every trial has its columns, their types, its
    seed and so many rows. A file that is not as it was written, or not of this study, is set aside,
    as .broken, and named in `broken`.
    """

    def __init__(self, folder: Path, like: pa.Table, of: bytes) -> None:
        self._folder, self._like, self._of = folder, like, of
        self._where: dict[int, Path] = {}  # the file of each trial
        self._failed: set[int] = set()
        self._single: dict[int, pa.Table] = {}  # not yet in a batch
        self._batches = 0
        self.broken: list[str] = []
        batches = sorted(folder.glob("batch_*.parquet"))
        for path in [*batches, *sorted(folder.glob("trial_*.parquet"))]:
            self._find(path)
        for path in {path for path in batches if path.exists()} - set(self._where.values()):
            path.unlink()  # every trial in it has run again
        if len(self._single) >= BATCH:
            self._compact()

    def _find(self, path: Path) -> None:
        """Take down which trials are in a file, or set it aside."""
        try:
            named = NAME.fullmatch(path.name)
            if named is None:
                raise ResultsError("no part has such a name")
            table = self._read(path)
            if named[1] == "trial":
                _require_only(table, int(named[2]))
        except ResultsError as error:
            if isinstance(error.__cause__, PermissionError):
                raise ResultsError(f"{path} cannot be read: {error}") from error
            path.replace(path.with_suffix(".broken"))
            self.broken.append(f"{path.name} ({error})")
            return
        if named[1] == "batch":
            self._batches = int(named[2]) + 1
        self._note(path, table)

    def _read(self, path: Path) -> pa.Table:
        """The rows of a part; ResultsError where they are not those that this study wrote."""
        of = sealed(path)
        if of is None:
            raise ResultsError("it has no seal: damaged, or not written by a study")
        if of != self._of:
            raise ResultsError("it is of a study of another configuration")
        file = _opened(path)
        table = _guarded(file.read)
        self._require_alike(table)
        return table

    def _require_alike(self, table: pa.Table) -> None:
        """Raise ResultsError unless these are rows of this study's trials, in order."""
        if not len(table):
            raise ResultsError("it has no rows")
        found = _unlike(table.schema, self._like.schema)
        if found:
            raise ResultsError(f"its columns are not those of this study: {found}")
        trial, seed = table["trial"], self._like["seed"][0]
        if trial.null_count or (np.diff(trial.to_numpy()) < 0).any():
            raise ResultsError("its trials are not in order")
        if table["seed"].unique().to_pylist() != [seed.as_py()]:
            raise ResultsError(f"it is not of seed {seed}")
        numbers, rows = np.unique(trial.to_numpy(), return_counts=True)
        for number in numbers[rows != len(self._like)]:
            count = rows[numbers == number][0]
            raise ResultsError(f"trial {number} has {count} rows, not {len(self._like)}")

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
        try:
            self._require_alike(table)  # or a rerun would set it aside
            _require_only(table, trial)
        except ResultsError as error:
            raise ResultsError(f"trial {trial} cannot be kept: {error}") from error
        _write([table], path, self._of)
        self._note(path, table)
        if len(self._single) >= BATCH:
            self._compact()

    def merge(self, whole: Path) -> None:
        """Write all trials, in order, into one file."""
        _write(self._in_order(), whole, self._of, keep=True)

    def _compact(self) -> None:
        """Make one file of the single ones."""
        batch = self._folder / f"batch_{self._batches:06d}.parquet"
        trials = sorted(self._single)
        table = pa.concat_tables([self._single[i] for i in trials])
        _write([table], batch, self._of, keep=True)
        self._batches += 1
        for i in trials:
            self._where[i].unlink()
            self._where[i] = batch
        self._single.clear()

    def _in_order(self) -> Iterator[pa.Table]:
        """The rows by trial, BATCH trials at a time."""
        read = lru_cache(maxsize=OPEN)(self._read)
        waiting: list[pa.Table] = []
        trials = 0
        for path, run in groupby(sorted(self._where), key=self._where.__getitem__):
            numbers = list(run)
            if path.name.startswith("trial_"):
                waiting.append(self._single[numbers[0]])
            else:
                try:
                    table = read(path)
                except ResultsError as error:
                    raise ResultsError(
                        f"{path} was spoilt while the study ran: {error}; the same command runs "
                        "what was in it again"
                    ) from error
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


def _require_only(table: pa.Table, trial: int) -> None:
    """Raise ResultsError where the rows are of another trial."""
    found = table["trial"].unique().to_pylist()
    if found != [trial]:
        more = ", and others" if len(found) > 1 else ""
        raise ResultsError(f"it holds trial {found[0]}{more}")


def _unlike(schema: pa.Schema, like: pa.Schema) -> str:
    """Where columns differ, in words; empty where they do not."""
    names, wanted = schema.names, like.names
    for some, others, word in ((wanted, names, "has no"), (names, wanted, "has")):
        found = [name for name in some if name not in others]
        if found:
            return f"it {word} {', '.join(map(repr, found[:3]))}"
    if names != wanted:
        return "their order is another"
    for one, other in zip(schema, like, strict=True):
        if one.type != other.type:
            return f"{one.name!r} is {one.type}, not {other.type}"
    return ""


# ---------------------------------------------------------------- all rows of a study

# What a column can be asked to hold, and the types that do.
HOLDS: Mapping[str, Callable[[pa.DataType], bool]] = {
    "whole numbers": pa.types.is_integer,
    "numbers": lambda t: pa.types.is_floating(t) or pa.types.is_integer(t) or pa.types.is_null(t),
    "true or false": pa.types.is_boolean,
    "texts": lambda t: pa.types.is_string(t) or pa.types.is_large_string(t) or pa.types.is_null(t),
}
NEVER_NULL = ("whole numbers", "true or false")


def read_results(
    path: Path, needed: Mapping[str, str], also: Mapping[str, str] | None = None
) -> pa.Table:
    """All rows of a study: the columns needed, and those of `also` that there are; None: all.

    Each name comes with what it holds, one of HOLDS. Raises ResultsError, which says why but not
    where, for a file that is not as it was written, or lacks a column or any rows.
    """
    sealed(path)
    file = _opened(path)
    names = file.schema_arrow.names
    there = {name: kind for name, kind in (also or {}).items() if name in names}
    for name, kind in {**needed, **there}.items():
        if names.count(name) != 1:
            raise ResultsError(f"it has {'two columns' if name in names else 'no column'} {name!r}")
        found = file.schema_arrow.field(name).type
        if not HOLDS[kind](found):
            raise ResultsError(f"its column {name!r} holds {found}, not {kind}")
    table = _guarded(lambda: file.read(None if also is None else [*needed, *there]))
    for name, kind in needed.items():
        if kind in NEVER_NULL and table[name].null_count:
            raise ResultsError(f"its column {name!r} has gaps")
    if not len(table):
        raise ResultsError("it has no rows")
    return table


def _opened(path: Path) -> pq.ParquetFile:
    return _guarded(lambda: pq.ParquetFile(path, page_checksum_verification=True))


def _guarded(read: Callable[[], T]) -> T:
    """What `read` returns; ResultsError for all that Arrow says of a broken file."""
    try:
        return read()
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError) as error:
        raise ResultsError(" ".join(str(error).split())[:80]) from error


# ---------------------------------------------------------------- files


def _write(tables: Iterable[pa.Table], path: Path, of: bytes, keep: bool = False) -> None:
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
        with part.open("r+b") as written:
            _seal(written, of)
            if keep:
                written.flush()
                os.fsync(written.fileno())


def _seal(file: BinaryIO, of: bytes) -> None:
    start = _footer(file)
    file.seek(start)
    footer = file.read()
    file.seek(start)
    file.write(MARK + of + bytes(DIGEST) + footer)
    digest = _digest(file, start)
    file.seek(start + SEAL - DIGEST)
    file.write(digest)


def sealed(path: Path) -> bytes | None:
    """The digest of the configuration that a file is of; None where it has no seal.

    Raises ResultsError for a file that is not as it was sealed, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = _footer(file) - SEAL
            file.seek(max(0, start))
            seal = file.read(SEAL)
            if start < 0 or not seal.startswith(MARK):
                return None
            if _digest(file, start) != seal[-DIGEST:]:
                raise ResultsError("its checksum does not fit: damaged since it was written")
            return seal[len(MARK) : -DIGEST]
    except ResultsError:
        raise
    except OSError as error:
        raise ResultsError(error.strerror or str(error)) from error


def _footer(file: BinaryIO) -> int:
    """Where a Parquet file's footer begins: its last eight bytes are its length and a word."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 8))
    return size - 8 - int.from_bytes(file.read(4), "little")


def _digest(file: BinaryIO, start: int) -> bytes:
    """Of all but the digest itself, in the seal that begins at `start`."""
    found = hashlib.sha256()
    file.seek(0)
    left = start + SEAL - DIGEST
    while block := file.read(min(left, 1 << 20)):
        found.update(block)
        left -= len(block)
    file.seek(start + SEAL)
    while block := file.read(1 << 20):
        found.update(block)
    return found.digest()
