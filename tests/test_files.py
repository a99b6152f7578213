"""Files are written whole or not at all, and a disk that is full is told in words."""

import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

import hqp_grasp as hg
from hqp_grasp.experiments.parts import Parts
from hqp_grasp.experiments.plots import convergence
from hqp_grasp.experiments.robot_check import draw
from hqp_grasp.experiments.scenario import Settings, run
from hqp_grasp.files import sweep, whole_file

SCENE = hg.Scene("bhand")
TRIAL = hg.Trial(SCENE, hg.stack_of("fmk"), probes=2)


@contextmanager
def full_disk(size):
    """Files take no more than `size` bytes, and then say what a full disk says but for a word."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    return hg.Study(TRIAL, trials=1).run(tmp_path_factory.mktemp("study"))


def test_a_file_takes_its_place_once_it_is_written(tmp_path):
    with whole_file(tmp_path / "a.txt") as part:
        part.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_what_cannot_be_written_leaves_what_was_there(tmp_path, error):
    file = tmp_path / "a.txt"
    file.write_text("old")

    def fail():
        with whole_file(file) as part:
            part.write_text("ne")
            raise error

    raised = hg.ResultsError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(raised, match=r"a\.txt cannot be written: No space left|^$"):
        fail()
    assert file.read_text() == "old" and list(tmp_path.iterdir()) == [file]


WRITERS = {
    "history.json": lambda path, table: hg.save_history(path, [touch()] * 9),
    "scene.json": lambda path, table: SCENE.save(path),
    "convergence.png": lambda path, table: convergence(table, "a", path),
    "robot.png": lambda path, table: draw(SCENE.articulated, path),
    "trial_000000.parquet": lambda path, table: Parts(path.parent, table, bytes(32)).add(0, table),
}


def touch():
    return hg.Touch([0.1] * 9, hg.Missed(hg.Miss.STUCK, "finger"))


@pytest.mark.parametrize("name", WRITERS)
def test_every_writer_says_that_the_disk_is_full(name, table, tmp_path):
    file = tmp_path / name
    with full_disk(100), pytest.raises(hg.ResultsError, match=f"{name} cannot be written: "):
        WRITERS[name](file, table)
    assert list(tmp_path.iterdir()) == []
    WRITERS[name](file, table)
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", WRITERS)
def test_every_writer_says_that_a_folder_is_missing(name, table, tmp_path):
    with pytest.raises(hg.ResultsError, match=r"cannot be written: .*[Nn]o such file"):
        WRITERS[name](tmp_path / "nowhere" / name, table)


def test_a_study_whose_disk_is_full_is_continued_by_the_same_command(tmp_path, monkeypatch):
    study, add = hg.Study(TRIAL, trials=3), Parts.add

    def fills(parts, trial, table):
        with full_disk(100 if trial == 1 else 10**9):
            add(parts, trial, table)

    monkeypatch.setattr(Parts, "add", fills)
    with pytest.raises(hg.ResultsError, match=r"trial_000001.* 1 trials are in .* same command"):
        study.run(tmp_path)
    monkeypatch.undo()
    assert study.run(tmp_path).num_rows == 9
    assert not list(tmp_path.rglob("*.part"))


def test_a_disk_that_is_full_when_the_figure_is_drawn_costs_the_figure_only(tmp_path, capsys):
    pytest.importorskip("viser", reason="the replay needs the extra hqp_grasp[view]")
    settings = Settings(trials=1, probes=1, jobs=1, out=tmp_path)
    run("cylinder", SCENE, settings)
    for name in ("convergence.png", "replay.html"):
        (tmp_path / name).unlink()
    capsys.readouterr()
    with full_disk(max(path.stat().st_size for path in tmp_path.iterdir()) + 1):
        run("cylinder", SCENE, settings)
    said = capsys.readouterr().out
    assert "converged" in said and f"results  {tmp_path / 'probes.parquet'}" in said
    for what, name in (("figure", "convergence.png"), ("replay", "replay.html")):
        assert f"{what}   none: {tmp_path / name} cannot be written: File too large" in said
    assert not list(tmp_path.rglob("*.part"))


def test_what_dead_processes_left_is_swept_and_what_is_being_written_stays(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    kept = f"trial_1.parquet.{os.getpid()}.part"
    for name in (kept, f"trial_2.parquet.{dead.pid}.part", "replay.part", "trial_3.parquet"):
        (tmp_path / name).touch()
    sweep(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {kept, "trial_3.parquet"}


def test_a_study_sweeps_its_folder(tmp_path):
    (tmp_path / "parts").mkdir()
    dead, alive = 4194305, os.getpid()  # a number that another process may have got since
    names = ("config.json", "probes.parquet", "parts/trial_000000.parquet")
    left = [tmp_path / f"{name}.{number}.part" for name in names for number in (dead, alive)]
    for path in left:
        path.write_text("half")
    hg.Study(TRIAL, trials=1).run(tmp_path)
    assert not any(path.exists() for path in left)


@pytest.mark.parametrize("made", [None, "a folder"])
def test_a_history_that_cannot_be_read_is_told(tmp_path, made):
    file = tmp_path / "history.json"
    if made:
        file.mkdir()
    with pytest.raises(hg.ResultsError, match=r"history\.json cannot be read: (No such|Is a dir)"):
        hg.load_history(file)
