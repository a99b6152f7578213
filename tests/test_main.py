"""The package's command line: scenarios without their folder, reports."""

import dataclasses
import inspect
import io
import subprocess
import sys

import pyarrow.parquet as pq
import pytest

import hqp_grasp as hg
from hqp_grasp.__main__ import judge, main, view
from hqp_grasp.experiments.picking import PickSettings
from hqp_grasp.experiments.scenario import Settings


def call(monkeypatch, *arguments):
    for name in [name for name in sys.modules if name.startswith("hqp_grasp.scenarios.")]:
        monkeypatch.delitem(sys.modules, name)  # as in a process of its own
    monkeypatch.setattr(sys, "argv", ["hqp_grasp", *map(str, arguments)])
    main()


def test_a_scenario_runs_by_its_name_and_is_reported(monkeypatch, capsys, tmp_path):
    out = tmp_path / "a"
    tiny = ("--trials", "2", "--probes", "2", "--jobs", "1")
    command = [sys.executable, "-m", "hqp_grasp", "run", "cylinder", *tiny, "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    assert pq.read_table(out / "probes.parquet").num_rows == 6
    capsys.readouterr()
    call(monkeypatch, "report", out, out)
    said = capsys.readouterr().out
    assert said.splitlines()[1].split()[:2] == [str(out), "2"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "cyclinder"), "unknown scenario 'cyclinder'; choose one of: beam, box, c"),
        (("report",), "at least one results folder"),
        (("report", "nowhere"), "no results folder"),
        (("view", "nowhere"), "there is no folder nowhere"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(monkeypatch, arguments, message):
    with pytest.raises(SystemExit, match=message):
        call(monkeypatch, *arguments)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    trial = hg.Trial(hg.Scene("bhand"), hg.ForceTask() >> hg.MomentTask(), probes=2)
    hg.Study(trial, trials=1).run(out)
    return out


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "cylinder", "--trials", "1", "--probes", "1", "--robot", "bhand", "--replay", "0"),
        ("run", "cylinder", "--help"),
        ("run", "cyclinder"),
        ("report", "RESULTS"),
        ("report", "nowhere"),
        ("robot", "bhand"),
        ("robot", "--help"),
        ("view", "nowhere"),
        ("--help",),
    ],
    ids=" ".join,
)
def test_every_command_speaks_to_any_terminal(monkeypatch, tmp_path, results, encoding, arguments):
    streams = {name: io.BytesIO() for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, io.TextIOWrapper(stream, encoding, write_through=True))
    monkeypatch.chdir(tmp_path)
    arguments = [str(results) if word == "RESULTS" else word for word in arguments]
    try:
        call(monkeypatch, *arguments)
    except SystemExit as end:
        print("" if end.code is None else end.code, file=sys.stderr)  # as Python does
    said = "".join(stream.getvalue().decode(encoding) for stream in streams.values())
    assert len(said) > 20 and "Traceback" not in said
    if encoding == "utf-8" and arguments[0] == "run" and len(arguments) > 3:
        assert "force ▷ moment ▷ kinematic" in said
    elif arguments[0] == "run" and len(arguments) > 3:
        assert "force > moment > kinematic" in said


def defaults(command):
    parameters = inspect.signature(command).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not p.empty}


def test_commands_do_by_default_what_their_pages_say():
    run = {f.name: f.default for f in dataclasses.fields(Settings)}
    assert (run["stack"], run["trials"], run["probes"], run["seed"]) == ("fmk", 40, 40, 0)
    assert (run["jobs"], run["cluster"], run["out"], run["strict"]) == (2, None, None, False)
    assert (run["form"], run["solver"], run["landing"]) == ("hierarchy", "proxqp", True)
    assert (run["kinematic_error"], run["links"], run["probe"]) == ("angle", "block", "geometric")
    assert (run["joint_cap"], run["contact_cap"]) == (0.35, 0.03)
    assert (run["replay"], run["view"], run["port"]) == (0, False, 8080)
    pick = {f.name: f.default for f in dataclasses.fields(PickSettings)}
    assert (pick["trials"], pick["mass"], pick["force"], pick["lift"]) == (20, 0.5, 5.0, 0.1)
    assert (pick["friction"], pick["actual_friction"], pick["timestep"]) == (0.5, 0.6, 0.004)
    assert (pick["probe"], pick["replay"], pick["view"]) == ("physical", 0, False)
    assert (pick["seed"], pick["jobs"]) == (0, 2)
    assert defaults(judge) == {
        **{"squeeze": ("hierarchy",), "protocol": ("pulls",), "force": 5.0, "mass": 0.1},
        **{"friction": 0.6, "believed": 0.5, "probe": None, "jobs": 2, "cluster": None},
    }
    assert defaults(view) == {
        **{"compare": None, "trial": None},
        **{"host": "127.0.0.1", "port": 8080},  # this machine only
    }
