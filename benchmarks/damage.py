"""Damage a results folder and a history at random; what is read is right, or says what is wrong.

    python benchmarks/damage.py --damages 2000 --seed 0

A file of a finished study (a part, a batch, the merged file, config.json) or a stored history has
bits flipped, is cut short, or gets a stretch of other bytes. Then the merged file is read, the
study runs again in its folder, and the history is loaded. Anything but the rows of the undisturbed
study, the touches that were stored, or a ResultsError of the reading is a failure; a rerun may not
end in one. Damage i of seed s draws from SeedSequence([s, i]): `--first i --damages 1` repeats it.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro

import hqp_grasp as hg
from hqp_grasp.experiments import parts
from hqp_grasp.experiments.parts import read_results

SCENE = hg.Scene("bhand")
TRIALS, ROWS, SEED = 7, 3, 5
BATCH = 4  # trials, so that the folder holds a batch and three files of a trial each


@dataclass(frozen=True)
class Options:
    """What is damaged is read as it was, or refused in words; a rerun makes it good."""

    damages: int = 2000
    """How many."""
    seed: int = 0
    """Damage i draws from SeedSequence([seed, i])."""
    first: int = 0
    """Number of the first."""


@dataclass(frozen=True)
class Quick:
    """What is studied: numbers, texts and lists drawn from the seed, in no time."""

    file: ClassVar[str] = "probes.parquet"
    scene: hg.Scene = SCENE

    def attempt(self, seed: Sequence[int]) -> Drawn:
        """Rows of random numbers."""
        return Drawn(np.random.default_rng(seed).random((ROWS, 4)))

    def nothing(self, seed: Sequence[int], error: str) -> Drawn:
        """Rows of zeros."""
        return Drawn(np.zeros((ROWS, 4)), error)


@dataclass(frozen=True, eq=False)
class Drawn:
    """The rows of one trial."""

    values: np.ndarray  # (ROWS, 4)
    error: str | None = None

    def to_table(self) -> pa.Table:
        """As a table."""
        columns: dict[str, pa.Array] = {
            "probe": pa.array(range(ROWS), pa.int64()),
            "in_contact": pa.array((self.values[:, 0] < 0.8).tolist()),
            "eps_f": pa.array(self.values[:, 0]),
            "name": pa.array([f"{v:.3f}" for v in self.values[:, 1]]),
            "looks": pa.array(
                [[{"t": v, "q": [v, w]}] for v, w in self.values[:, 2:]],
                pa.list_(pa.struct({"t": pa.float64(), "q": pa.list_(pa.float64())})),
            ),
            "error": pa.array([self.error] * ROWS, pa.string()),
        }
        return pa.table(columns)


STUDY = hg.Study(Quick(), TRIALS, SEED)
NEEDED = {"trial": "whole numbers", "eps_f": "numbers", "name": "texts"}


def history() -> tuple[hg.Touch, ...]:
    """Two touches of three joints, and a miss between them."""
    rng = np.random.default_rng(SEED)

    def touch() -> hg.Touch:
        contacts = [hg.Contact(rng.random(3), np.eye(3)[i], f"tip_{i}") for i in range(3)]
        return hg.Touch(rng.random(3), hg.Grasp(rng.random(3), tuple(contacts), rng.random((9, 3))))

    missed = hg.Touch(rng.random(3), hg.Missed(hg.Miss.STUCK, "tip_1"))
    return touch(), missed, touch()


@contextlib.contextmanager
def prepared() -> Iterator[tuple[Path, pa.Table]]:
    """A folder with the finished study and a stored history, and the study's rows."""
    before, parts.BATCH = parts.BATCH, BATCH
    try:
        with tempfile.TemporaryDirectory() as where:
            folder = Path(where) / "sound"
            table = run(folder)
            hg.save_history(folder / "history.json", history())
            yield folder, table
    finally:
        parts.BATCH = before


def run(folder: Path) -> pa.Table:
    """The study's rows, without its progress."""
    with contextlib.redirect_stderr(io.StringIO()):
        return STUDY.run(folder)


def damage(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """The content of a file with something wrong, and what."""
    kind = rng.choice(["bit", "bits", "cut", "stretch", "grown"], p=[0.5, 0.15, 0.2, 0.1, 0.05])
    spoilt = bytearray(content)
    at = int(rng.integers(len(content)))
    if rng.random() < 0.3:  # near the end, where the footer is
        at = max(0, len(content) - 1 - int(rng.integers(64)))
    if kind == "cut":
        return "cut", bytes(spoilt[:at])
    if kind == "grown":
        return "grown", bytes(spoilt) + rng.bytes(int(rng.integers(1, 50)))
    if kind == "stretch":
        other = rng.bytes(int(rng.integers(1, 200)))
        return "stretch", bytes(spoilt[:at] + other + spoilt[at + len(other) :])
    for place in [at, *rng.integers(len(content), size=0 if kind == "bit" else 7)]:
        spoilt[place] ^= 1 << int(rng.integers(8))
    return str(kind), bytes(spoilt)


def fault(sound: Path, right: pa.Table, rng: np.random.Generator) -> tuple[str, str]:
    """Damage one file of a copy of `sound`; the file's kind, and what came of it that is wrong."""
    files = sorted(path for path in sound.rglob("*.*") if path.name != "scene.json")
    file = files[int(rng.integers(len(files)))].relative_to(sound)
    kind = file.name.partition("_")[0]
    folder = sound.with_name("spoilt")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sound, folder)
    how, content = damage((folder / file).read_bytes(), rng)
    (folder / file).write_bytes(content)
    try:
        wrong = [_history(folder), _merged(folder, right), _rerun(folder, right)]
    except Exception as error:
        return kind, f"{file}, {how}: {error!r}"
    return kind, "".join(f"{file}, {how}: {word}; " for word in wrong if word)


def _history(folder: Path) -> str:
    """What is wrong with the history as it is loaded."""
    path = folder / "history.json"
    try:
        found = hg.load_history(path)
    except hg.ResultsError as error:
        return "" if str(path) in str(error) else f"unnamed: {error}"
    hg.save_history(folder / "again", found)
    right = folder.with_name("sound") / "history.json"
    return "" if (folder / "again").read_bytes() == right.read_bytes() else "another history"


def _merged(folder: Path, right: pa.Table) -> str:
    """What is wrong with the merged rows as a report reads them."""
    try:
        table = read_results(folder / "probes.parquet", NEEDED, None)
    except hg.ResultsError:
        return ""
    return "" if table.equals(right, check_metadata=True) else "other rows are read"


def _rerun(folder: Path, right: pa.Table) -> str:
    """What is wrong once the study has run again, twice."""
    for _ in range(2):
        table = run(folder)
        if not table.equals(right, check_metadata=True):
            return "a rerun ends with other rows"
        if not pq.read_table(folder / "probes.parquet").equals(right):
            return "a rerun leaves other rows"
    return ""


def main(options: Options) -> None:
    """Damage, and count."""
    done, faults = Counter[str](), []
    with prepared() as (sound, right):
        for i in range(options.first, options.first + options.damages):
            kind, wrong = fault(sound, right, np.random.default_rng([options.seed, i]))
            done[kind] += 1
            if wrong:
                faults.append(f"{i}: {wrong}")
    print(f"{sum(done.values())} damages of seed {options.seed}, {len(faults)} faults")
    print("of " + ", ".join(f"{kind} {count}" for kind, count in sorted(done.items())))
    print("\n".join(faults))


if __name__ == "__main__":
    main(tyro.cli(Options))
