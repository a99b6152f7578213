"""Many trials: resumed where they stopped, written whole or not at all, refused by name."""

import dataclasses
import json
import os
import re
import shutil

import pyarrow.parquet as pq
import pytest
from own_law import ManyThreadsTask

from hqp_grasp.control.controller import Controller
from hqp_grasp.errors import (
    InputError,
    ReachError,
    ResultsError,
    SolverError,
    TrialError,
    WorkerError,
)
from hqp_grasp.experiments import executor, fingerprint, parts
from hqp_grasp.experiments import study as module
from hqp_grasp.experiments.record import COLUMNS, empty_row
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.tasks import ForceTask, stack_of
from hqp_grasp.world.scene import Cylinder, Scene

TRIALS, PROBES, SEED = 3, 3, 7
TIMINGS = ["solve_us"]
# Column: its type, and the unit its meaning begins with (None: it has no unit).
CONTRACT = {
    "trial": ("int64", None),
    "seed": ("int64", None),
    "cpu": ("string", None),
    "probe": ("int64", None),
    "eps_f": ("double", "N^2"),
    "eps_m": ("double", "(N m)^2"),
    "eps_k": ("double", "rad"),
    "eps_k_eq7": ("double", "m/rad"),
    "adduction_deg": ("double", "deg"),
    "elevation_deg": ("double", "deg"),
    "in_contact": ("bool", "bool"),
    "limit_active": ("bool", "bool"),
    "limit_violation": ("double", "rad"),
    "hqp_projection_gap": ("double", "rad"),
    "solve_us": ("double", "us"),
}


@pytest.fixture(scope="module")
def trial():
    return Trial(Scene(), stack_of("fm"), probes=PROBES)


@pytest.fixture(scope="module")
def study(trial):
    return Study(trial, TRIALS, SEED)


@pytest.fixture(scope="module")
def done(study, tmp_path_factory):
    """A folder with the whole study, and its table."""
    out = tmp_path_factory.mktemp("study") / "results"
    return out, study.run(out)


@pytest.fixture
def folder(done, tmp_path):
    """A copy of that folder, to be spoilt."""
    return shutil.copytree(done[0], tmp_path / "copy")


@pytest.fixture
def ran(monkeypatch):
    """Numbers of the trials that are run from here on."""
    numbers = []
    run_one = module._run_one

    def counted(trial, seed, i):
        numbers.append(i)
        return run_one(trial, seed, i)

    monkeypatch.setattr(module, "_run_one", counted)
    return numbers


def same(one, other):
    """Equal bit for bit, schema and all, timings aside."""
    return one.drop_columns(TIMINGS).equals(other.drop_columns(TIMINGS), check_metadata=True)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# ---------------------------------------------------------------- what is written


def test_rows_are_ordered_by_trial_and_probe(done):
    out, table = done
    assert pq.read_table(out / "probes.parquet").equals(table)
    keys = [(row["trial"], row["seed"], row["probe"]) for row in table.to_pylist()]
    assert keys == [(i, SEED, p) for i in range(TRIALS) for p in range(PROBES + 1)]


def test_the_schema_has_the_contracts_columns_with_their_units(done):
    schema = pq.read_schema(done[0] / "probes.parquet")
    for name, (kind, unit) in CONTRACT.items():
        field = schema.field(name)
        assert str(field.type) == kind
        meaning = field.metadata[b"meaning"].decode()
        assert unit is None or meaning.startswith(f"{unit}:")
    assert all(field.metadata[b"meaning"] for field in schema)
    assert set(COLUMNS) < set(schema.names)


def test_joint_angles_are_kept_with_every_touch(done, trial):
    joints = trial.scene.articulated.joints
    table = done[1].select([f"q_{joint}" for joint in joints])
    record = trial.run((SEED, 1))
    grasps = iter(record.grasps)
    for row, told in zip(table.to_pylist()[PROBES + 1 :], record.rows, strict=False):
        angles = next(grasps).q.tolist() if told["in_contact"] else [None] * len(joints)
        assert list(row.values()) == angles
    assert next(grasps, None) is None


def test_one_file_a_trial_and_no_leftovers(done):
    out, _ = done
    assert names(out) == ["config.json", "parts", "probes.parquet", "scene.json"]
    assert names(out / "parts") == [f"trial_{i:06d}.parquet" for i in range(TRIALS)]


def test_the_folder_says_what_was_run(done):
    config = json.loads((done[0] / "config.json").read_text())
    assert config["seed"] == SEED
    assert {"numpy", "mujoco", "proxsuite", "python"} <= set(config["versions"])
    trial = config["trial"]
    assert trial["scene"]["robot"]["name"] == "wam_bhand" and trial["probes"] == PROBES
    assert trial["scene"]["object"]["radius"] == 0.05
    assert trial["stack"]["priorities"][0][0]["class"].endswith("ForceTask")
    assert config["hqp_grasp"].startswith("sha256:") and config["unknown"] == []


def test_a_lost_trial_has_null_errors_and_rows_to_the_end(trial):
    record = trial.run((SEED, 0))
    nothing = [empty_row(trial.scene.articulated, trial.stack) for _ in range(PROBES)]
    lost = dataclasses.replace(record, rows=(record.rows[0], *nothing), grasps=record.grasps[:1])
    table = lost.to_table()
    assert table.num_rows == PROBES + 1
    for name in ("eps_f", "error_force", "status_force", "rank_force", "contact_1_x", "q_wam_j1"):
        assert table.column(name).slice(1).null_count == PROBES
    assert table.column("in_contact").to_pylist() == [True] + PROBES * [False]


# ---------------------------------------------------------------- processes


def test_two_processes_give_the_same_table_bit_for_bit(done, study, tmp_path):
    table = dataclasses.replace(study, jobs=2).run(tmp_path / "results")
    assert same(table, done[1])
    assert names(tmp_path / "results" / "parts") == names(done[0] / "parts")


# ---------------------------------------------------------------- resuming


def test_a_finished_study_runs_nothing_again(done, study, folder, ran):
    assert study.run(folder).equals(done[1])
    assert ran == []


def test_only_what_is_missing_is_run_again(done, study, folder, ran):
    (folder / "parts" / "trial_000001.parquet").unlink()
    (folder / "probes.parquet").unlink()
    table = study.run(folder)
    assert ran == [1]
    assert same(table, done[1])
    assert same(pq.read_table(folder / "probes.parquet"), done[1])


def test_a_study_can_go_on_with_more_trials(done, study, folder, ran):
    table = dataclasses.replace(study, trials=TRIALS + 1).run(folder)
    assert ran == [TRIALS]
    assert table.slice(0, done[1].num_rows).equals(done[1])
    assert table.num_rows == (TRIALS + 1) * (PROBES + 1)


def test_fewer_trials_are_the_first_ones_and_the_file_keeps_the_others(done, study, folder, ran):
    table = dataclasses.replace(study, trials=1).run(folder)
    assert ran == []
    assert table.equals(done[1].slice(0, PROBES + 1))
    assert pq.read_table(folder / "probes.parquet").equals(done[1])


def test_a_folder_may_be_named_by_a_text(done, study, folder, ran):
    assert study.run(str(folder)).equals(done[1])
    assert ran == []


def test_a_file_half_written_by_a_killed_run_is_ignored(done, study, folder, ran):
    part = folder / "parts" / "trial_000002.parquet"
    part.with_suffix(".99999.part").write_bytes(part.read_bytes()[:100])
    part.unlink()
    assert same(study.run(folder), done[1])
    assert ran == [2]


def test_an_interrupted_study_keeps_its_complete_trials(monkeypatch, done, study, tmp_path):
    out, run_one = tmp_path / "results", module._run_one

    def interrupted(trial, seed, i):
        if i == 1:
            raise KeyboardInterrupt
        return run_one(trial, seed, i)

    monkeypatch.setattr(module, "_run_one", interrupted)
    with pytest.raises(KeyboardInterrupt):
        study.run(out)
    assert names(out) == ["config.json", "parts", "scene.json"]
    assert names(out / "parts") == ["trial_000000.parquet"]
    monkeypatch.setattr(module, "_run_one", run_one)
    assert same(study.run(out), done[1])


def test_an_interrupt_while_writing_leaves_no_broken_trial(monkeypatch, done, study, folder):
    part = folder / "parts" / "trial_000000.parquet"
    part.unlink()
    write_table = pq.ParquetWriter.write_table

    def torn(writer, table):
        write_table(writer, table)
        raise KeyboardInterrupt

    monkeypatch.setattr(pq.ParquetWriter, "write_table", torn)
    with pytest.raises(KeyboardInterrupt):
        study.run(folder)
    assert not part.exists()
    monkeypatch.setattr(pq.ParquetWriter, "write_table", write_table)
    assert same(study.run(folder), done[1])


# ---------------------------------------------------------------- failing trials


@pytest.fixture
def failing(monkeypatch):
    """Trials that fail from here on, at their second step."""
    numbers, step, begin, trial = set(), Controller.step, Trial.begin, [0]

    def beginning(self, entropy, probe):
        trial[0] = entropy[-1]
        return begin(self, entropy, probe)

    def raising(self, history):
        if trial[0] in numbers and len(history) == 2:
            raise SolverError(f"no answer in trial {trial[0]}")
        return step(self, history)

    monkeypatch.setattr(Trial, "begin", beginning)
    monkeypatch.setattr(Controller, "step", raising)
    return numbers


def test_a_failing_trial_is_recorded_and_the_others_go_on(done, study, tmp_path, failing):
    failing.add(1)
    table = study.run(tmp_path / "results")
    assert pq.read_table(tmp_path / "results" / "probes.parquet").equals(table)
    rows = table.to_pylist()
    assert table.num_rows == TRIALS * (PROBES + 1)
    for row, whole in zip(rows, done[1].to_pylist(), strict=True):
        if row["trial"] != 1:
            assert row["error"] is None
        else:
            assert row["error"] == "SolverError: no answer in trial 1"
        if row["trial"] != 1 or row["probe"] < 2:
            assert row["q_wam_j1"] == whole["q_wam_j1"] and row["eps_f"] == whole["eps_f"]
        else:
            assert row["in_contact"] is False
            told = {name for name, value in row.items() if value not in (None, False, 0.0, "")}
            assert told <= {"trial", "seed", "cpu", "probe", "rejected", "error", "unbalanced"}


def test_a_rerun_tries_failed_trials_again_and_no_others(done, study, tmp_path, failing, ran):
    out = tmp_path / "results"
    failing.update((0, 2))
    study.run(out)
    failing.clear()
    ran.clear()
    assert same(study.run(out), done[1])
    assert ran == [0, 2]
    ran.clear()
    study.run(out)
    assert ran == []


def test_run_of_the_same_seed_raises_what_ended_a_trial(study, failing):
    failing.add(1)
    with pytest.raises(SolverError, match="no answer in trial 1"):
        study.trial.run((SEED, 1))


def test_a_strict_study_stops_at_the_first_failure_with_the_rest_on_disk(
    done, study, tmp_path, failing, ran
):
    out = tmp_path / "results"
    failing.update((1, 2))
    strict = dataclasses.replace(study, strict=True)
    with pytest.raises(TrialError, match=f"trial 1 of seed {SEED} ended by SolverError") as caught:
        strict.run(out)
    assert caught.value.trial == 1
    assert ran == [0, 1]
    assert pq.read_table(out / "probes.parquet").num_rows == 2 * (PROBES + 1)
    failing.clear()
    assert same(strict.run(out), done[1])


def test_every_worker_has_one_blas_thread_and_a_strict_study_stops_there_too(
    trial, tmp_path, monkeypatch
):
    """The law refuses the one BLAS thread that every worker has."""
    for name in executor.THREADS:
        monkeypatch.delenv(name, raising=False)
    broken = dataclasses.replace(trial, stack=ManyThreadsTask())
    study = Study(broken, 8, SEED, jobs=2, strict=True)
    with pytest.raises(TrialError, match="1 BLAS threads; raised by the law 'manythreads'"):
        study.run(tmp_path / "results")
    errors = pq.read_table(tmp_path / "results" / "probes.parquet").column("error")
    assert errors.null_count == 0 and len(errors) > 0
    assert not any(name in os.environ for name in executor.THREADS)


@pytest.fixture
def starting(monkeypatch):
    """Trials of which these find no start, from here on."""
    numbers, begin = set(), Trial.begin

    def beginning(self, entropy, probe):
        if entropy[-1] in numbers:
            raise ReachError("out of reach; move the object")
        return begin(self, entropy, probe)

    monkeypatch.setattr(Trial, "begin", beginning)
    return numbers


def test_a_study_whose_first_trial_finds_no_start_runs_no_other(
    study, tmp_path, starting, ran, done
):
    starting.update(range(TRIALS))
    out = tmp_path / "results"
    message = "trial 0 of .* ended by ReachError: out of reach; move the object; no other trial"
    for _ in range(2):  # nor when it is asked again
        with pytest.raises(TrialError, match=message):
            study.run(out)
    assert ran == [0, 0]
    assert pq.read_table(out / "probes.parquet").num_rows == PROBES + 1
    starting.clear()
    assert same(study.run(out), done[1])


def test_a_study_goes_on_where_a_trial_has_found_a_start(study, tmp_path, starting, ran):
    starting.update(range(1, TRIALS))
    table = study.run(tmp_path / "results")
    assert ran == list(range(TRIALS)) and table.num_rows == TRIALS * (PROBES + 1)
    assert study.run(tmp_path / "results").num_rows == TRIALS * (PROBES + 1)


def test_a_start_found_counts_though_its_trial_failed(study, tmp_path, starting, failing, ran):
    failing.add(0)
    starting.add(1)
    study.run(tmp_path / "results")
    assert ran == list(range(TRIALS))


def test_a_trial_whose_process_always_dies_is_a_failing_trial(done, study, tmp_path, monkeypatch):
    def deadly(work, numbers, jobs, cluster):
        return ((i, None if i == 1 else work(i)) for i in numbers)

    with monkeypatch.context() as patched:
        patched.setattr(module, "run_all", deadly)
        table = study.run(tmp_path / "results")
    assert table.schema.equals(done[1].schema, check_metadata=True)
    errors = dict(zip(table["trial"].to_pylist(), table["error"].to_pylist(), strict=True))
    assert errors == {0: None, 1: errors[1], 2: None}
    assert errors[1].startswith("WorkerError: its process died each time")
    assert table.num_rows == TRIALS * (PROBES + 1)
    assert same(study.run(tmp_path / "results"), done[1])


def test_where_the_workers_are_gone_it_is_said_how_to_continue(done, study, tmp_path, monkeypatch):
    def vanishing(work, numbers, jobs, cluster):
        yield 0, work(0)
        raise WorkerError("the scheduler is gone")

    out = tmp_path / "results"
    with monkeypatch.context() as patched:
        patched.setattr(module, "run_all", vanishing)
        with pytest.raises(WorkerError) as caught:
            study.run(out)
    told = f"the scheduler is gone; 1 trials are in {out}, and the same command continues"
    assert str(caught.value) == told
    assert same(study.run(out), done[1])


# ---------------------------------------------------------------- parts


def test_a_broken_part_is_told_and_its_trial_runs_again(done, study, folder, ran, capsys):
    part = folder / "parts" / "trial_000001.parquet"
    part.write_bytes(part.read_bytes()[:-9])
    assert same(study.run(folder), done[1])
    assert ran == [1]
    told = f"{part} (it has no seal"
    assert told in capsys.readouterr().err


def test_a_folder_of_batches_is_continued_and_merged_in_order(
    done, study, folder, ran, monkeypatch
):
    monkeypatch.setattr(parts, "BATCH", 2)
    table = dataclasses.replace(study, trials=TRIALS + 2).run(folder)
    assert ran == [TRIALS, TRIALS + 1]
    assert names(folder / "parts") == ["batch_000000.parquet", "batch_000001.parquet"]
    assert same(table.slice(0, done[1].num_rows), done[1])
    assert table["trial"].to_pylist() == sorted(table["trial"].to_pylist())
    ran.clear()
    assert study.run(folder).equals(done[1])
    assert ran == []


def test_only_the_columns_asked_for_are_returned(done, study, folder):
    few = ("probe", "eps_f")
    assert study.run(folder, columns=few).equals(done[1].select(few))


# ---------------------------------------------------------------- refusals


def test_of_two_runs_that_begin_at_once_in_a_fresh_folder_one_is_refused(study, tmp_path, ran):
    other = dataclasses.replace(study, seed=SEED + 1)
    with module._claimed(tmp_path, study.configuration()):
        before = (tmp_path / "config.json").read_bytes()
        (tmp_path / "config.json").unlink()  # as if the other had not yet written it
        with pytest.raises(ResultsError, match="is being written by another run"):
            other.run(tmp_path)
        (tmp_path / "config.json").write_bytes(before)
    assert ran == []


def test_a_folder_that_another_run_writes_is_refused(study, folder, ran):
    with (
        module._claimed(folder, study.configuration()),
        pytest.raises(ResultsError, match="is being written by another run; wait until"),
    ):
        study.run(folder)
    assert ran == []
    study.run(folder)


DAMAGED = ["", "{", '{"seed": 7', "[7]", "[" * 100_000, "another seed", "no checksum", "\xff"]


@pytest.fixture(params=DAMAGED, ids=lambda text: text[:12])
def damaged(request, folder):
    """A folder whose config.json is not what was written."""
    config = folder / "config.json"
    text = request.param
    if text == "another seed":
        text = config.read_text().replace(f'"seed": {SEED}', f'"seed": {SEED + 1}')
    elif text == "no checksum":
        text = config.read_text().replace("sha256", "sha257")
    config.write_text(text, encoding="latin-1")
    return folder


def test_a_damaged_config_is_told_and_written_again_where_a_part_says_whose_it_is(
    done, study, damaged, ran, capsys
):
    assert study.run(damaged).equals(done[1])
    assert "config.json cannot be read or was changed: set aside" in capsys.readouterr().err
    assert (damaged / "config.json").read_bytes() == (done[0] / "config.json").read_bytes()
    assert (damaged / "config.broken").exists() and ran == []
    study.run(damaged)


def test_results_whose_config_is_damaged_are_refused_to_another_study(study, damaged, ran):
    before = {path: path.read_bytes() for path in damaged.rglob("*.*")}
    with pytest.raises(ResultsError, match=r"config\.json cannot be read, .*another --out"):
        dataclasses.replace(study, seed=SEED + 1).run(damaged)
    assert ran == [] and before == {path: path.read_bytes() for path in damaged.rglob("*.*")}


def test_what_is_no_address_of_a_cluster_is_said_before_any_work(trial):
    with pytest.raises(InputError, match="the address of a Dask scheduler"):
        Study(trial, cluster="node7")


@pytest.mark.parametrize("other", ["seed", "probes", "stack", "object", "form"])
def test_a_folder_of_another_configuration_is_refused_before_any_work(study, folder, ran, other):
    trial = study.trial
    changed = {
        "seed": dataclasses.replace(study, seed=SEED + 1),
        "probes": dataclasses.replace(study, trial=dataclasses.replace(trial, probes=2)),
        "stack": dataclasses.replace(
            study, trial=dataclasses.replace(trial, stack=stack_of("fmk"))
        ),
        "object": dataclasses.replace(
            study, trial=dataclasses.replace(trial, scene=Scene(object=Cylinder(0.04)))
        ),
        "form": dataclasses.replace(study, trial=dataclasses.replace(trial, form="paper")),
    }[other]
    (folder / "parts" / "trial_000000.parquet").unlink()
    before = (folder / "probes.parquet").read_bytes()
    where = {"object": "radius", "stack": "priorities"}.get(other, other)
    with pytest.raises(ResultsError, match=rf"another configuration: .*{where}.*another --out"):
        changed.run(folder)
    assert ran == []
    assert (folder / "probes.parquet").read_bytes() == before


def test_another_package_source_is_said(study, folder, monkeypatch):
    monkeypatch.setattr(fingerprint, "PACKAGE", folder)
    with pytest.raises(ResultsError, match="another configuration: hqp_grasp differs; take"):
        study.run(folder)


def test_only_the_first_differences_are_told(study, folder):
    trial = Trial(Scene(object=Cylinder(0.04, 0.1)), stack_of("m"), probes=2, landing=False)
    with pytest.raises(ResultsError, match=r"another configuration: .*, and \d more; take another"):
        Study(trial, TRIALS, SEED + 1).run(folder)


def test_what_cannot_be_compared_runs_in_a_fresh_folder_and_is_never_continued(
    trial, tmp_path, ran
):
    @dataclasses.dataclass(frozen=True)
    class InnerTask(ForceTask):
        pass

    study = Study(dataclasses.replace(trial, stack=InnerTask(), probes=1), 1)
    out = tmp_path / "results"
    assert study.run(out).column("error").null_count == 2
    with pytest.raises(
        ResultsError, match=r"cannot be told: .*InnerTask.*inside a function.*--out"
    ):
        study.run(out)
    assert ran == [0]


def test_results_that_do_not_say_what_they_are_of_are_refused(study, folder, ran):
    (folder / "config.json").unlink()
    with pytest.raises(ResultsError, match=r"without a config\.json; take another folder"):
        study.run(folder)
    assert ran == []


@pytest.mark.parametrize("where", ["a_file", "a_file/below"])
def test_a_folder_that_cannot_be_written_is_named_before_any_work(study, tmp_path, ran, where):
    (tmp_path / "a_file").write_text("")
    out = tmp_path / where
    with pytest.raises(ResultsError, match=re.escape(f"{out} cannot be written")):
        study.run(out)
    assert ran == []


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"trials": 0}, "trials must be at least 1; got 0"),
        ({"seed": -1}, "seed must be at least 0; got -1"),
        ({"jobs": 0}, "jobs must be at least 1; got 0"),
        ({"trials": -3}, "trials must be at least 1; got -3"),
    ],
)
def test_a_wrong_setting_is_named(trial, setting, message):
    with pytest.raises(InputError, match=message):
        Study(trial, **setting)
