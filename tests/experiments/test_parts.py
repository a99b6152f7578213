"""Finished trials on disk: never half a file, never 100,000 files, in order in the end."""

import itertools
import signal
import subprocess
import sys
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hqp_grasp.errors import ResultsError
from hqp_grasp.experiments import parts as module
from hqp_grasp.experiments.parts import Parts

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "damage.py"
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


def rewritten(change):
    """A part written again by somebody else, its table changed."""
    return lambda path: pq.write_table(change(pq.read_table(path)), path)


def copied(name):
    """Another file of the study in the place of a part."""
    return lambda path: path.write_bytes((path.parent / name).read_bytes())


def of_another_study(path):
    module._write([table(9)], path, bytes(32))


def of_another_seed(path):
    rows = table(9)
    module._write([rows.set_column(1, "seed", pa.array([SEED + 1] * ROWS))], path, OF)


def written_so(change):
    """A part sealed as ours, whatever it holds."""
    return lambda path: module._write([change(table(9))], path, OF)


def renamed(table):
    return table.rename_columns(["trial", "seed", "probe", "worth", "error"])


def retyped(table):
    return table.set_column(3, "value", table["value"].cast(pa.string()))


def permuted(table):
    return table.select(["value", "trial", "seed", "probe", "error"])


NAME_FLIPPED = b"error", b"urror"
SPOILT = {  # how trial 9's file is spoilt, and the reason that is told
    "a name in the footer": (
        lambda path: path.write_bytes(path.read_bytes().replace(*NAME_FLIPPED)),
        "checksum does not fit",
    ),
    "the seal": (
        lambda path: path.write_bytes(
            path.read_bytes().replace(b"hqp_grasp sha", b"hqp_grasp sya")
        ),
        "no seal",
    ),
    "by somebody else": (rewritten(lambda rows: rows), "no seal"),
    "fewer rows by somebody else": (rewritten(lambda rows: rows[:1]), "no seal"),
    "another trial": (copied("trial_000008.parquet"), "it holds trial 8"),
    "a batch": (copied("batch_000001.parquet"), "it holds trial 4"),
    "another study": (of_another_study, "another configuration"),
    "another seed": (of_another_seed, f"not of seed {SEED}"),
    "renamed": (written_so(renamed), "has no 'value'"),
    "one more column": (
        written_so(lambda rows: rows.append_column("more", rows["probe"])),
        "has 'more'",
    ),
    "retyped": (written_so(retyped), "'value' is string, not double"),
    "permuted": (written_so(permuted), "order is another"),
    "fewer rows": (written_so(lambda rows: rows[:2]), f"trial 9 has 2 rows, not {ROWS}"),
    "no rows": (written_so(lambda rows: rows[:0]), "no rows"),
    "two trials": (
        written_so(lambda rows: pa.concat_tables([rows, table(10)])),
        "it holds trial 9, and others",
    ),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "Is a directory"),
}


@pytest.mark.parametrize("how", SPOILT)
def test_a_part_that_does_not_fit_is_set_aside_by_name_with_the_reason(tmp_path, how):
    added(tmp_path, range(10))
    spoil, reason = SPOILT[how]
    spoil(tmp_path / "trial_000009.parquet")
    parts = opened(tmp_path)
    (told,) = parts.broken
    assert told.startswith("trial_000009.parquet (") and reason in told
    assert [i for i in range(11) if not parts.is_done(i)] == [9, 10]
    parts.add(9, table(9))
    assert merged(parts, tmp_path).equals(expected(range(10)))
    assert opened(tmp_path).broken == [] and (tmp_path / "trial_000009.broken").exists()


def test_a_batch_in_the_place_of_another_is_no_other_and_its_trials_count_once(tmp_path):
    added(tmp_path, range(8))
    copied("batch_000000.parquet")(tmp_path / "batch_000001.parquet")
    parts = opened(tmp_path)
    assert [i for i in range(8) if parts.is_done(i)] == [0, 1, 2, 3]
    for i in range(4, 8):
        parts.add(i, table(i))
    assert merged(parts, tmp_path).equals(expected(range(8)))


@pytest.mark.parametrize(
    "stray", ["batch_foo", "trial_foo", "trial_1", "trial_000001 (copy)", "batch_-00001"]
)
def test_a_stray_file_is_set_aside_by_name(tmp_path, stray):
    added(tmp_path, range(5))
    file = tmp_path / f"{stray}.parquet"
    file.write_bytes((tmp_path / "trial_000004.parquet").read_bytes())
    parts = opened(tmp_path)
    assert parts.broken == [f"{stray}.parquet (no part has such a name)"]
    assert merged(parts, tmp_path).equals(expected(range(5)))
    assert (tmp_path / f"{stray}.broken").exists() and not file.exists()


def test_files_of_other_kinds_are_left_alone(tmp_path):
    added(tmp_path, range(2))
    for name in ("notes.txt", "other.parquet"):
        (tmp_path / name).write_text("mine")
    assert opened(tmp_path).broken == []
    assert {"notes.txt", "other.parquet"} < set(names(tmp_path))


def test_a_part_that_may_not_be_read_stays_where_it_is(tmp_path, monkeypatch):
    added(tmp_path, range(2))

    def refuse(path, *args):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ResultsError, match=r"trial_000000\.parquet cannot be read: Permission"):
        opened(tmp_path)
    assert names(tmp_path) == ["trial_000000.parquet", "trial_000001.parquet"]


def test_rows_that_a_rerun_would_set_aside_are_not_kept(tmp_path):
    parts = opened(tmp_path)
    with pytest.raises(ResultsError, match=r"trial 3 cannot be kept: .* 'value' is string"):
        parts.add(3, retyped(table(3)))
    with pytest.raises(ResultsError, match="trial 3 cannot be kept: trial 3 has 2 rows, not 3"):
        parts.add(3, table(3)[:2])
    with pytest.raises(ResultsError, match="trial 3 cannot be kept: it holds trial 4"):
        parts.add(3, table(4))
    assert names(tmp_path) == []


def test_a_batch_spoilt_while_the_study_runs_is_named_as_it_is_merged(tmp_path):
    parts = added(tmp_path, range(8))
    batch = tmp_path / "batch_000001.parquet"
    batch.write_bytes(batch.read_bytes()[:-1])
    with pytest.raises(ResultsError, match=r"batch_000001\.parquet was spoilt while .* again"):
        merged(parts, tmp_path)


def test_other_readers_see_nothing_of_a_seal(tmp_path):
    added(tmp_path, [0])
    part = tmp_path / "trial_000000.parquet"
    assert pq.read_table(part).equals(table(0), check_metadata=True)
    assert module.sealed(part) == OF


# ---------------------------------------------------------------- all rows of a study


NEEDED = {"trial": "whole numbers", "value": "numbers", "error": "texts"}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda rows: rows.drop_columns(["value"]), "no column 'value'"),
        (lambda rows: rows.append_column("value", rows["value"]), "two columns 'value'"),
        (lambda rows: rows[:0], "no rows"),
        (retyped, "'value' holds string, not numbers"),
        (lambda rows: rows.set_column(0, "trial", pa.array([1, None, 2])), "'trial' has gaps"),
        (lambda rows: rows.set_column(0, "trial", pa.array([1.0, 1.0, 2.0])), "not whole numbers"),
    ],
)
def test_rows_without_what_a_reader_needs_are_refused(tmp_path, change, reason):
    pq.write_table(change(table(1)), tmp_path / "whole.parquet")
    with pytest.raises(ResultsError, match=reason):
        module.read_results(tmp_path / "whole.parquet", NEEDED)


def test_a_reader_gets_what_it_needs_and_what_else_there_is_of_what_it_asks_for(tmp_path):
    pq.write_table(table(1), tmp_path / "whole.parquet")
    read = partial(module.read_results, tmp_path / "whole.parquet", NEEDED)
    assert read({"probe": "whole numbers", "x": "texts"}).column_names == [*NEEDED, "probe"]
    assert read(None).equals(table(1))


def test_whatever_is_damaged_is_right_or_refused_in_words_and_made_good_by_a_rerun(monkeypatch):
    """benchmarks/damage.py does so 2,000 times."""
    spec = spec_from_file_location("damage", BENCHMARK)
    damage = module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "damage", damage)  # dataclasses look their module up
    spec.loader.exec_module(damage)
    with damage.prepared() as sound:
        found = [damage.fault(*sound, np.random.default_rng([1, i])) for i in range(30)]
    assert {kind for kind, _ in found} >= {"trial", "batch", "probes.parquet", "history.json"}
    assert [wrong for _, wrong in found if wrong] == []


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


# ---------------------------------------------------------------- how files are written


def seal_of(path):
    """The seal of a file; what is said where it does not hold."""
    try:
        return module.sealed(path)
    except ResultsError as error:
        return str(error)


def test_whatever_byte_of_a_file_is_changed_its_seal_does_not_hold(tmp_path):
    added(tmp_path, [0])
    path = tmp_path / "trial_000000.parquet"
    whole = path.read_bytes()
    assert seal_of(path) == OF
    flipped = [
        whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :]
        for at, flip in zip(range(0, len(whole), 7), itertools.cycle((0x01, 0x80)), strict=False)
    ]
    for change in (*flipped, whole[1:], whole[:-1], whole + b"\0", b"", whole[:8]):
        path.write_bytes(change)
        assert seal_of(path) in (None, "its checksum does not fit: damaged since it was written")


def test_a_large_file_is_sealed_as_a_small_one_is(tmp_path):
    """Digests read a mebibyte at a time."""
    noise = np.random.default_rng(0).random(300_000)
    rows = pa.table({"trial": np.zeros(300_000, int), "value": noise})
    module._write([rows], tmp_path / "large.parquet", OF)
    path = tmp_path / "large.parquet"
    assert path.stat().st_size > 2 * (1 << 20) and module.sealed(path) == OF
    content = bytearray(path.read_bytes())
    for at in (100, 1 << 20, (1 << 20) + 1, 2 * (1 << 20) + 5, len(content) - 20):
        content[at] ^= 1
        path.write_bytes(content)
        with pytest.raises(ResultsError, match="checksum does not fit"):
            module.sealed(path)
        content[at] ^= 1


def test_what_stays_is_packed_small_and_what_goes_soon_is_packed_fast(tmp_path):
    parts = added(tmp_path, range(5))
    merged(parts, tmp_path)
    packing = {}
    for path in tmp_path.iterdir():
        column = pq.ParquetFile(path).metadata.row_group(0).column(0)
        packing[path.name] = column.compression
    assert packing == {
        "batch_000000.parquet": "ZSTD",
        "trial_000004.parquet": "SNAPPY",
        "whole.parquet": "ZSTD",
    }
    assert module._unlike(table(0).schema, table(0).schema) == ""


def test_at_most_three_columns_that_are_missing_are_named():
    whole = table(0)
    few = whole.select(["trial"])
    assert module._unlike(few.schema, whole.schema) == "it has no 'seed', 'probe', 'value'"
    assert module._unlike(whole.schema, few.schema) == "it has 'seed', 'probe', 'value'"


@pytest.mark.parametrize(
    ("kind", "values", "holds"),
    [
        ("whole numbers", pa.array([1, 2], pa.int32()), True),
        ("whole numbers", pa.array([1.0, 2.0]), False),
        ("numbers", pa.array([1, 2]), True),
        ("numbers", pa.array([1.0, None]), True),
        ("numbers", pa.nulls(2), True),
        ("numbers", pa.array(["1", "2"]), False),
        ("true or false", pa.array([True, False]), True),
        ("true or false", pa.array([1, 0]), False),
        ("texts", pa.array(["a", None]), True),
        ("texts", pa.array(["a", "b"], pa.large_string()), True),
        ("texts", pa.nulls(2), True),
        ("texts", pa.array([1, 2]), False),
    ],
)
def test_a_column_holds_what_a_reader_asks_of_it(tmp_path, kind, values, holds):
    pq.write_table(pa.table({"x": values}), tmp_path / "whole.parquet")
    read = partial(module.read_results, tmp_path / "whole.parquet", {"x": kind})
    if holds:
        assert read()["x"].to_pylist() == values.to_pylist()
    else:
        with pytest.raises(ResultsError, match=f"column 'x' holds .*, not {kind}"):
            read()


def test_a_reader_is_told_of_gaps_only_where_there_may_be_none(tmp_path):
    for kind, values in (("whole numbers", [1, None]), ("true or false", [True, None])):
        pq.write_table(pa.table({"x": pa.array(values)}), tmp_path / "whole.parquet")
        with pytest.raises(ResultsError, match="column 'x' has gaps"):
            module.read_results(tmp_path / "whole.parquet", {"x": kind})
