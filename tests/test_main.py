"""The package's command line: scenarios without their folder, reports."""

import dataclasses
import inspect
import io
import platform
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import hqp_grasp as hg
from hqp_grasp.__main__ import judge, main, view
from hqp_grasp.errors import requirements
from hqp_grasp.experiments.picking import PickSettings
from hqp_grasp.experiments.scenario import Settings

ROOT = Path(__file__).parents[1]


def call(monkeypatch, *arguments):
    for name in [name for name in sys.modules if name.startswith("hqp_grasp.scenarios.")]:
        monkeypatch.delitem(sys.modules, name)  # as in a process of its own
    monkeypatch.setattr(sys, "argv", ["hqp-grasp", *map(str, arguments)])
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


def test_the_version_is_the_package_s_own(monkeypatch, capsys):
    call(monkeypatch, "--version")
    assert capsys.readouterr().out == f"hqp_grasp {hg.__version__}\n"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert hg.__version__ == project["version"]
    assert project["scripts"] == {"hqp-grasp": "hqp_grasp.__main__:main"}


@pytest.mark.parametrize("scenario", ["cylinder", "prism", "object"])
@pytest.mark.parametrize("command", ["run", "pick"])
def test_help_names_the_command_that_was_typed(monkeypatch, capsys, command, scenario):
    with pytest.raises(SystemExit):
        call(monkeypatch, command, scenario, "--help")
    said = capsys.readouterr().out
    assert said.startswith(f"usage: hqp-grasp {command} {scenario} [-h]")
    assert ".py" not in said and "--probes 60" not in said


def test_the_doctor_tells_versions_and_what_is_missing_and_that_the_solver_works(
    monkeypatch, capsys
):
    monkeypatch.setattr("shutil.which", lambda name: None)
    extra = {"view": {"tyro": "tyro>=1.0", "no-such-viewer": "no-such-viewer>=2"}}
    found = {"": {"numpy": "numpy>=2.0"}} | extra
    monkeypatch.setattr("hqp_grasp.experiments.doctor.requirements", lambda: found)
    call(monkeypatch, "doctor")
    said = dict(line.strip().split(maxsplit=1) for line in capsys.readouterr().out.splitlines()
                if " " in line.strip())  # fmt: skip
    assert said["hqp_grasp"].startswith(f"{hg.__version__}, ")
    assert said["python"].startswith(platform.python_version())
    assert said["needs"] == f"numpy {np.__version__}"
    assert said["view"].endswith("missing: pip install 'no-such-viewer>=2'")
    assert "compiled" in said["solver"] and "kept in" in said["solver"]
    assert said["browser"].startswith("no chromium") and "EGL" in said["renderer"]


def test_requirements_are_read_by_extra_as_pyproject_has_them():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    stated = {"": project["dependencies"]} | project["optional-dependencies"]
    found = {extra: list(needed.values()) for extra, needed in requirements().items()}
    assert found == stated
    assert set(requirements()["bench"]) == {"clarabel", "pin-pink"}


def test_no_command_is_spelled_in_another_way():
    texts = [ROOT / "README.md", ROOT / "Makefile", *ROOT.glob("docs/*.md")]
    texts += [
        p for room in ("hqp_grasp", "scenarios", "benchmarks") for p in ROOT.glob(f"{room}/**/*.py")
    ]
    old = re.compile(r"-m hqp_grasp(\.scenarios|\s+\w)|(python|PY\)) scenarios/")
    assert [p.name for p in texts if old.search(p.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("command", ["run", "pick"])
@pytest.mark.parametrize(("more", "code"), [((), 2), (("--help",), 0), (("--trials", "1"), 2)])
def test_a_command_without_a_scenario_says_how_it_is_called(
    monkeypatch, capsys, command, more, code
):
    with pytest.raises(SystemExit) as ended:
        call(monkeypatch, command, *more)
    assert ended.value.code == code
    said = "".join(capsys.readouterr())
    assert f"hqp-grasp {command}" in said


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
