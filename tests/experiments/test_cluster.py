"""Studies on a Dask cluster: the same bits, whatever is killed."""

import dataclasses
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from deadly import Square, raises

import hqp_grasp as hg
from hqp_grasp.errors import WorkerError
from hqp_grasp.experiments import executor
from hqp_grasp.experiments.executor import run_all

IN_FLIGHT = 2

distributed = pytest.importorskip(
    "distributed", reason="no distributed: pip install 'hqp_grasp[cluster]'"
)
TESTS = Path(__file__).parents[1]
PACKAGE = Path(executor.__file__).parents[1]
TRIALS, SEED = 24, 5


@pytest.fixture(scope="module")
def study():
    scene = hg.Scene(object=hg.Cylinder(0.05))
    return hg.Study(hg.Trial(scene, hg.ForceTask() >> hg.MomentTask(), probes=3), TRIALS, SEED)


@pytest.fixture(scope="module")
def expected(study, tmp_path_factory):
    """The study, uninterrupted, in this process."""
    return study.run(tmp_path_factory.mktemp("here") / "results")


def same(one, other):
    """Equal bit for bit, schema and all, timings aside."""
    timings = ["solve_us"]
    return one.drop_columns(timings).equals(other.drop_columns(timings), check_metadata=True)


def cluster_of(workers, processes):
    return distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=processes,
        protocol="tcp://",
        dashboard_address=":0",  # any free port: 8787 may be another's
    )


@pytest.fixture(scope="module")
def near():
    """A cluster within this process."""
    with cluster_of(2, processes=False) as cluster:
        yield cluster


# ---------------------------------------------------------------- quick: one process


def test_a_cluster_gives_the_same_bits(near, study, expected, tmp_path):
    there = dataclasses.replace(study, trials=4, cluster=near.scheduler_address)
    assert same(there.run(tmp_path / "there"), expected.slice(0, 4 * 4))


def test_no_more_than_a_few_a_worker_are_under_way(near):
    numbers = range(60)
    for _ in run_all(Square(), numbers, cluster=near.scheduler_address):
        under_way = [key for key in near.scheduler.tasks if str(key).startswith("hqp_grasp")]
        assert len(under_way) <= IN_FLIGHT * len(near.workers) + 1


def test_what_the_work_raises_ends_the_study_with_its_reason(near):
    with pytest.raises(WorkerError, match="cannot do the work: RuntimeError: not here"):
        list(run_all(raises, range(4), cluster=near.scheduler_address))


def test_the_address_of_a_worker_is_none_of_a_scheduler(near):
    address = near.workers[0].address
    with pytest.raises(WorkerError, match=r"no Dask scheduler answers at tcp:.*is a worker"):
        executor._Cluster(Square(), address).__enter__()


def test_a_scheduler_without_workers_is_told_and_not_waited_for_for_ever(capsys, monkeypatch):
    monkeypatch.setattr(executor, "WORKERS", 0.3)
    monkeypatch.setattr(executor, "ASK", 0.2)
    with (
        cluster_of(0, processes=False) as empty,
        pytest.raises(WorkerError, match=r"has had no worker for 0\.3 s"),
    ):
        list(run_all(Square(), range(4), cluster=empty.scheduler_address))
    assert re.search("has no worker: .*; `dask worker .* --nthreads 1`", capsys.readouterr().err)


# ---------------------------------------------------------------- slow: processes are killed


@contextmanager
def processes(folder, workers=2, path=()):
    """A scheduler and its workers as processes: the scheduler's, and the scheduler file."""
    file = folder / "scheduler.json"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*map(str, path), str(TESTS)])}

    def start(kind, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments]
        return subprocess.Popen(
            [*command, "--scheduler-file", str(file), "--no-dashboard"],
            env=environment,
            cwd=folder,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    scheduler = start("scheduler", "--host", "127.0.0.1", "--port", "0")
    worker = start("worker", "--nworkers", str(workers), "--nthreads", "1")
    try:
        while not file.is_file():
            time.sleep(0.1)
        yield scheduler, file
    finally:
        for process in (scheduler, worker):
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.cluster
def test_a_worker_killed_at_any_moment_changes_no_bit(study, expected, tmp_path):
    with cluster_of(2, processes=True) as cluster:
        there = dataclasses.replace(study, cluster=cluster.scheduler_address)
        for run in range(3):
            delay = random.Random(run).uniform(0.2, 2.0)
            victim = next(iter(cluster.workers.values())).process.pid
            timer = threading.Timer(delay, os.kill, (victim, signal.SIGKILL))
            timer.start()
            out = tmp_path / f"run_{run}"
            assert same(there.run(out), expected)
            timer.join()
            cluster.wait_for_workers(2)


@pytest.mark.cluster
def test_a_trial_that_kills_every_worker_is_given_up_and_costs_no_other():
    with cluster_of(2, processes=True) as cluster:
        address = cluster.scheduler_address
        done = dict(run_all(Square(deadly=(2,)), range(12), cluster=address))
    assert done == {i: None if i == 2 else i * i for i in range(12)}


@pytest.mark.cluster
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_scheduler_that_vanishes_ends_the_study_and_a_rerun_continues(
    study, expected, tmp_path, end
):
    out = tmp_path / "results"
    with processes(tmp_path) as (scheduler, file):
        there = dataclasses.replace(study, cluster=file)
        ended = {}

        def vanish():
            while len(list(out.glob("parts/trial_*.parquet"))) < 3:
                time.sleep(0.05)
            scheduler.send_signal(end)
            ended["at"] = time.monotonic()

        watch = threading.Thread(target=vanish)
        watch.start()
        with pytest.raises(WorkerError, match=r"is gone .* trials are in .* the same command"):
            there.run(out)
        assert time.monotonic() - ended["at"] < 30.0
        watch.join()
    finished = len(list(out.glob("parts/trial_*.parquet")))
    assert 3 <= finished < TRIALS
    assert same(study.run(out), expected)


@pytest.mark.cluster
def test_workers_with_another_source_are_refused(study, tmp_path):
    copy = shutil.copytree(PACKAGE, tmp_path / "other" / "hqp_grasp")
    (copy / "errors.py").write_text((copy / "errors.py").read_text() + "# another\n")
    for data in ("robots", "scenarios"):
        shutil.copytree(PACKAGE.parent / data, copy / data)
    with processes(tmp_path, path=[tmp_path / "other"]) as (_, file):
        there = dataclasses.replace(study, cluster=file)
        with pytest.raises(WorkerError, match="differs from the client: hqp_grasp differs"):
            there.run(tmp_path / "results")


@pytest.mark.cluster
def test_the_command_line_runs_on_a_cluster_and_says_how_to_continue(tmp_path):
    run = [sys.executable, "-m", "hqp_grasp", "run", "cylinder", "--trials", "4", "--probes", "2"]
    with processes(tmp_path, workers=1) as (_, file):
        command = [*run, "--out", "there", "--cluster", str(file)]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
        address = json.loads(file.read_text())["address"]
    assert pq.read_table(tmp_path / "there" / "probes.parquet").num_rows == 12
    more = [*run, "--trials", "6", "--out", "there", "--cluster", address]
    said = subprocess.run(more, cwd=tmp_path, check=False, capture_output=True, text=True)
    assert said.returncode == 1
    assert f"no Dask scheduler answers at {address} within" in said.stderr
    assert "4 trials are in there, and the same command continues" in said.stderr
