"""Finished trials on disk: never half a file, never 100,000 files, in order in the end."""

import signal
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hqp_grasp.experiments import parts as module
from hqp_grasp.experiments.parts import Parts

ROWS, SEED = 3, 7
OF = bytes(range(32))  # what stands for the digest of a configuration


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    monkeypatch.setattr(module, "BATCH", 4)


def table(trial, value=0.0, error=None):
    return pa.table(
        {
            "trial": pa.array([trial] * ROWS, pa.int64()),
            "seed": pa.array([SEED] * ROWS, pa.int64()),
            "probe": pa.array(range(ROWS), pa.int64()),
            "value": pa.array([value + trial] * ROWS),
            "error": pa.array([error] * ROWS, pa.string()),
        }
    )


def opened(folder):
    return Parts(folder, table(0), OF)


def added(folder, trials, value=0.0, error=None):
    parts = opened(folder)
    for i in trials:
        parts.add(i, table(i, value, error))
    return parts


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def merged(parts, folder):
    parts.merge(folder / "whole.parquet")
    return pq.read_table(folder / "whole.parquet")


def expected(trials, value=0.0):
    return pa.concat_tables([table(i, value) for i in trials])


def test_a_batch_takes_the_place_of_single_files(tmp_path):
    parts = added(tmp_path, [3, 1, 0, 2, 7])
    assert names(tmp_path) == ["batch_000000.parquet", "trial_000007.parquet"]
    assert merged(parts, tmp_path).equals(expected([0, 1, 2, 3, 7]))


def test_all_trials_are_merged_in_order_however_they_came(tmp_path):
    order = [(7 * i) % 23 for i in range(23)]
    parts = added(tmp_path, order)
    assert merged(parts, tmp_path).equals(expected(range(23)))
    assert merged(opened(tmp_path), tmp_path).equals(expected(range(23)))


def test_the_whole_is_written_in_row_groups_of_a_batch(tmp_path):
    merged(added(tmp_path, range(23)), tmp_path)
    whole = pq.ParquetFile(tmp_path / "whole.parquet").metadata
    assert [whole.row_group(i).num_rows for i in range(whole.num_row_groups)] == [12] * 5 + [9]


def test_merging_holds_few_batches_at_a_time(tmp_path, monkeypatch):
    parts = added(tmp_path, range(40))
    reads, read = [], Parts._read
    monkeypatch.setattr(Parts, "_read", lambda self, path: reads.append(path) or read(self, path))
    merged(parts, tmp_path)
    assert len(reads) == 10 == len(set(reads))


def test_a_trial_that_ran_again_wins_over_its_batch_and_later_batches_over_earlier(tmp_path):
    added(tmp_path, range(8), error="SolverError: no")
    parts = added(tmp_path, [1, 5], value=10.0)
    assert [i for i in range(8) if parts.is_done(i)] == [1, 5]
    values = merged(parts, tmp_path)["value"].to_pylist()[::ROWS]
    assert values == [0, 11, 2, 3, 4, 15, 6, 7]
    parts = added(tmp_path, [0, 2, 3, 4], value=20.0)  # makes a batch
    assert not opened(tmp_path).is_done(6)
    values = merged(opened(tmp_path), tmp_path)["value"].to_pylist()[::ROWS]
    assert values == [20, 11, 22, 23, 24, 15, 6, 7]


def test_a_batch_of_which_every_trial_ran_again_goes(tmp_path):
    added(tmp_path, range(4))
    added(tmp_path, range(4), value=5.0)
    assert names(tmp_path) == ["batch_000000.parquet", "batch_000001.parquet"]
    parts = opened(tmp_path)
    assert names(tmp_path) == ["batch_000001.parquet"]
    assert merged(parts, tmp_path).equals(expected(range(4), 5.0))


def test_killed_between_writing_a_batch_and_removing_its_trials_nothing_is_lost_or_double(tmp_path):
    singles = added(tmp_path, range(3))
    kept = {path: path.read_bytes() for path in tmp_path.iterdir()}
    singles.add(3, table(3))
    for path, content in kept.items():
        path.write_bytes(content)
    parts = opened(tmp_path)
    assert len(parts) == 4
    assert merged(parts, tmp_path).equals(expected(range(4)))


@pytest.mark.parametrize("spoil", ["cut", "empty", "flipped", "no columns"])
@pytest.mark.parametrize("name", ["trial_000009.parquet", "batch_000001.parquet"])
def test_a_broken_file_is_told_and_only_its_trials_are_missing(tmp_path, name, spoil):
    added(tmp_path, range(10))
    path = tmp_path / name
    content = bytearray(path.read_bytes())
    if spoil == "cut":
        content = content[: len(content) // 2]
    elif spoil == "empty":
        content = b""
    elif spoil == "flipped":
        content[len(content) // 8] ^= 0xFF  # in a page of data
    else:
        pq.write_table(pa.table({"x": [1]}), path)
        content = path.read_bytes()
    path.write_bytes(content)
    parts = opened(tmp_path)
    (told,) = parts.broken
    assert told.startswith(f"{name} (")
    lost = [9] if name.startswith("trial") else [4, 5, 6, 7]
    assert [i for i in range(10) if not parts.is_done(i)] == lost
    for i in lost:
        parts.add(i, table(i))
    assert merged(parts, tmp_path).equals(expected(range(10)))
    assert opened(tmp_path).broken == []
    assert path.with_suffix(".broken").read_bytes() == content


KILLED = """
import sys; from pathlib import Path; sys.path.insert(0, sys.argv[2])
import test_parts as t
t.module.BATCH = 4
parts = t.opened(Path(sys.argv[1]))
print("ready", flush=True)
for i in range(10_000):
    parts.add(i, t.table(i))
"""


def test_killed_at_any_moment_every_file_is_whole(tmp_path):
    for pause in (0.01, 0.05, 0.1, 0.2):
        folder = tmp_path / str(pause)
        folder.mkdir()
        command = [sys.executable, "-c", KILLED, str(folder), str(Path(__file__).parent)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
            writer.stdout.readline()
            with pytest.raises(subprocess.TimeoutExpired):
                writer.wait(pause)
            writer.send_signal(signal.SIGKILL)
        parts = opened(folder)
        done = [i for i in range(10_000) if parts.is_done(i)]
        assert parts.broken == [] and done == list(range(len(done)))
        if done:
            assert merged(parts, tmp_path).equals(expected(done))
