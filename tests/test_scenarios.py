"""Every scenario is one command, from a clone or installed; a bad file costs one line."""

import runpy
import subprocess
import sys
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import hqp_grasp as hg

FOLDER = Path(__file__).parents[1] / "scenarios"
CORNERS = runpy.run_path(str(FOLDER / "irregular.py"))["CORNERS"]
TINY = ["--trials", "1", "--probes", "2", "--jobs", "1", "--out", "results"]
OBJECTS = {
    "cylinder": hg.Cylinder(0.05),
    "cylinder_65": hg.Cylinder(0.065),
    "hexagon": hg.Prism.regular(6, 0.06),
    "irregular": hg.Prism(CORNERS),
}
TWO_ARMED = {
    "drum": ("both", hg.Cylinder(0.2, 0.4)),
    "box": ("both", hg.Prism.box(0.3, 0.4, 0.3)),
    "beam": ("palms", hg.Prism.box(0.1, 0.6, 0.1)),
}
FROM_FILES = ("object", "prism")


def run(cwd, *arguments):
    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, capture_output=True, text=True, check=False
    )


def call(monkeypatch, module, *arguments):
    """Do in this process what `python -m hqp_grasp.scenarios.MODULE ARGUMENTS` does."""
    module = f"hqp_grasp.scenarios.{module}"
    monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setattr(sys, "argv", [module, *arguments])
    runpy.run_module(module, run_name="__main__")


def test_there_is_a_scenario_for_every_object_of_the_paper_and_for_files():
    names = {path.stem for path in FOLDER.glob("*.py")} - {"__init__"}
    assert names == {*OBJECTS, *TWO_ARMED, *FROM_FILES}


@pytest.mark.parametrize("name", [*OBJECTS, *TWO_ARMED, *FROM_FILES])
def test_a_scenario_is_short(name):
    assert 10 <= len((FOLDER / f"{name}.py").read_text().splitlines()) <= 60


@pytest.mark.parametrize("name", OBJECTS)
def test_a_scenario_declares_its_object(name):
    scene = runpy.run_path(str(FOLDER / f"{name}.py"))["scene"]
    assert scene == hg.Scene(object=OBJECTS[name])


@pytest.mark.parametrize("name", TWO_ARMED)
def test_a_scenario_of_two_arms_declares_its_object_and_what_grasps_it(name):
    scene = runpy.run_path(str(FOLDER / f"{name}.py"))["scene"]
    hand, thing = TWO_ARMED[name]
    assert scene == hg.Scene("umass_torso", thing, hand=hand)
    assert len(scene.articulated.groups) == 2


def test_three_unit_forces_never_balance_on_the_faces_of_the_irregular_prism_alone():
    sides = np.roll(CORNERS, -1, axis=0) - np.array(CORNERS)
    normals = np.column_stack([sides[:, 1], -sides[:, 0]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    triples = combinations_with_replacement(normals, 3)
    least = min(float(np.sum(np.sum(triple, axis=0) ** 2)) for triple in triples)
    assert least == pytest.approx(0.0428, abs=1e-4)


def test_an_outline_off_the_origin_is_recentred_and_told(tmp_path):
    (tmp_path / "corners.csv").write_text("x,y\n100,0\n180,0\n180,80\n100,80\n")
    script = FOLDER / "prism.py"
    done = run(tmp_path, script, "--corners", "corners.csv", "--scale", "0.001", *TINY)
    assert done.returncode == 0, done.stderr
    assert "corners.csv: the outline's centroid, (140.0, 40.0) mm, is the origin" in done.stdout
    assert pq.read_table(tmp_path / "results" / "probes.parquet").num_rows == 3


def test_an_object_runs_from_its_file_and_results_of_another_are_not_continued(
    tmp_path, monkeypatch
):
    geom = "<geom type='cylinder' size='{} 0.06'/>"
    body = f"<mujoco><worldbody><body>{geom}</body></worldbody></mujoco>"
    command = ("-m", "hqp_grasp.scenarios.object", "--object", "can.xml", *TINY)
    (tmp_path / "can.xml").write_text(body.format(0.05))
    done = run(tmp_path, *command)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("object-can: force ▷ moment ▷ kinematic")
    (tmp_path / "can.xml").write_text(body.format(0.04))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="content"):
        call(monkeypatch, "object", "--object", "can.xml", *TINY)


@pytest.mark.parametrize(
    ("script", "option", "name", "text", "message"),
    [
        ("prism", "--corners", "c.csv", "0,0\n0,0.1\n0.1,0\n", "prism-c: c.csv runs clockwise"),
        ("prism", "--corners", "c.csv", None, "prism-c: cannot read corners from c.csv"),
        ("object", "--object", "o.obj", "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 2 3\n"
         "f 1 2 4\n", "is not closed"),
        ("object", "--object", "o.xml", None, "object-o: no file"),
    ],
)  # fmt: skip
def test_a_bad_file_costs_one_line_and_no_work(
    tmp_path, monkeypatch, capsys, script, option, name, text, message
):
    if text is not None:
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        call(monkeypatch, script, option, name, *TINY)
    assert capsys.readouterr() == ("", "")
    assert message in end.value.code and len(end.value.code.splitlines()) == 1
    assert not (tmp_path / "results").exists()
