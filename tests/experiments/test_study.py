"""Many trials: resumed where they stopped, written whole or not at all, refused by name."""

import dataclasses
import json
import re
import shutil

import pyarrow.parquet as pq
import pytest

from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments import study as module
from hqp_grasp.experiments.record import COLUMNS, empty_row
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.tasks import stack_of
from hqp_grasp.world.scene import Cylinder, Scene

TRIALS, PROBES, SEED = 3, 3, 7
TIMINGS = ["solve_us"]
# Column: its type, and the unit its meaning begins with (None: it has no unit).
CONTRACT = {
    "trial": ("int64", None),
    "seed": ("int64", None),
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

    def counted(trial, seed, i, parts):
        numbers.append(i)
        run_one(trial, seed, i, parts)

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
    for row, grasp in zip(table.to_pylist()[PROBES + 1 :], record.grasps, strict=False):
        assert list(row.values()) == grasp.q.tolist()


def test_one_file_a_trial_and_no_leftovers(done):
    out, _ = done
    assert names(out) == ["config.json", "parts", "probes.parquet"]
    assert names(out / "parts") == [f"trial_{i:06d}.parquet" for i in range(TRIALS)]


def test_the_folder_says_what_was_run(done):
    config = json.loads((done[0] / "config.json").read_text())
    assert config["seed"] == SEED
    assert {"hqp_grasp", "mujoco", "proxsuite"} <= set(config["versions"])
    for part in ("wam_bhand", "Cylinder(radius=0.05", "ForceTask", f"probes={PROBES}"):
        assert part in config["trial"]


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


def test_fewer_trials_are_the_first_ones(done, study, folder, ran):
    table = dataclasses.replace(study, trials=1).run(folder)
    assert ran == []
    assert table.equals(done[1].slice(0, PROBES + 1))


def test_a_file_half_written_by_a_killed_run_is_ignored(done, study, folder, ran):
    part = folder / "parts" / "trial_000002.parquet"
    part.with_suffix(".99999.part").write_bytes(part.read_bytes()[:100])
    part.unlink()
    assert same(study.run(folder), done[1])
    assert ran == [2]


def test_an_interrupted_study_keeps_its_complete_trials(monkeypatch, done, study, tmp_path):
    out, run_one = tmp_path / "results", module._run_one

    def interrupted(trial, seed, i, parts):
        if i == 1:
            raise KeyboardInterrupt
        run_one(trial, seed, i, parts)

    monkeypatch.setattr(module, "_run_one", interrupted)
    with pytest.raises(KeyboardInterrupt):
        study.run(out)
    assert names(out) == ["config.json", "parts"]
    assert names(out / "parts") == ["trial_000000.parquet"]
    monkeypatch.setattr(module, "_run_one", run_one)
    assert same(study.run(out), done[1])


def test_an_interrupt_while_writing_leaves_no_broken_trial(monkeypatch, done, study, folder):
    part = folder / "parts" / "trial_000000.parquet"
    part.unlink()
    write_table = pq.write_table

    def torn(table, path):
        write_table(table, path)
        path.write_bytes(path.read_bytes()[:50])
        raise KeyboardInterrupt

    monkeypatch.setattr(pq, "write_table", torn)
    with pytest.raises(KeyboardInterrupt):
        study.run(folder)
    assert not part.exists()
    monkeypatch.setattr(pq, "write_table", write_table)
    assert same(study.run(folder), done[1])


# ---------------------------------------------------------------- refusals


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
    with pytest.raises(ResultsError, match=r"another configuration.*another --out"):
        changed.run(folder)
    assert ran == []
    assert (folder / "probes.parquet").read_bytes() == before


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
    ],
)
def test_a_wrong_setting_is_named(trial, setting, message):
    with pytest.raises(InputError, match=message):
        Study(trial, **setting)
