"""The package's command line: scenarios without their folder, reports."""

import subprocess
import sys

import pyarrow.parquet as pq
import pytest

from hqp_grasp.__main__ import main


def call(monkeypatch, *arguments):
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
        (("run", "cyclinder"), "unknown scenario 'cyclinder'; choose one of: cylinder, "),
        (("report",), "at least one results folder"),
        (("report", "nowhere"), "no results folder"),
        (("view", "nowhere"), "there is no folder nowhere"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(monkeypatch, arguments, message):
    with pytest.raises(SystemExit, match=message):
        call(monkeypatch, *arguments)
