"""The live viewer: a results folder, any trial and probe of it, in the browser."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace
from typing import ClassVar

import browser
import numpy as np
import pyarrow.parquet as pq
import pytest

import hqp_grasp as hg
from hqp_grasp.errors import MissingExtraError
from hqp_grasp.experiments import scenario
from hqp_grasp.experiments.fingerprint import Fingerprint
from hqp_grasp.experiments.record import secures, verdicts
from hqp_grasp.experiments.replay import _quiet_server
from hqp_grasp.experiments.view import Results, Viewer, _numbers, serve

pytest.importorskip("viser", reason="no viser: pip install 'hqp_grasp[view]'")

TRIALS, PROBES = 5, 6
SCENE = hg.Scene()


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Results of two forms from the same starts, and of another seed."""
    where = tmp_path_factory.mktemp("results")
    runs = {"strict": {}, "paper": {"form": "paper"}, "other_seed": {"seed": 1, "trials": 1}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "viser", None)  # no replay is needed here
        for name, changed in runs.items():
            settings = {"trials": TRIALS, "probes": PROBES, "jobs": 1, "out": where / name}
            scenario.run("cylinder", SCENE, scenario.Settings(**settings | changed))
    return where


# ---------------------------------------------------------------- the folder


def test_a_folder_is_read_a_trial_at_a_time(folders):
    results = Results.open(folders / "strict")
    assert (results.trials, results.probes, results.seed) == (TRIALS, PROBES, 0)
    assert results.scene == SCENE and results.same_scene
    table = pq.read_table(folders / "strict" / "probes.parquet")
    rows, verdict = table.to_pylist(), verdicts(table)
    assert results.failures == {
        kind: tuple(trial for trial, found in verdict.items() if found == kind)
        for kind in ("error", "lost", "not balanced", "link inside", "violation")
    }
    assert results.rows(3) == [row for row in rows if row["trial"] == 3]
    assert results.secure == sum(secures(table).values())


def test_a_probe_says_what_friction_holds_it(folders):
    results = Results.open(folders / "strict")
    row = results.rows(3)[5]
    said = _numbers(3, 5, [(results, row), (results, row | {"friction_demand": np.inf})])
    held = f"holds if µ ≥ {row['friction_demand']:.2f}"
    assert f"| friction_demand |{held}|no friction holds it|" in said
    older = {name: value for name, value in row.items() if name != "friction_demand"}
    assert "holds" not in _numbers(3, 5, [(results, older)])


def test_a_folder_from_before_friction_demands_opens(folders, tmp_path):
    shutil.copytree(folders / "strict", tmp_path / "old")
    path = tmp_path / "old" / "probes.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["friction_demand", "unbalanced"]), path)
    assert Results.open(tmp_path / "old").secure is None


@pytest.mark.parametrize(
    "scene",
    [
        SCENE,
        hg.Scene(robot="bhand", object=hg.Cylinder(0.04, height=0.2), position=(0.1, 0.2, 0.3)),
        hg.Scene(robot="bhand", base=(0.1, 0.2, 0.3, 0.6, 0.0, 0.8, 0.0)),
        hg.Scene(object=hg.Prism(((0.05, 0.0), (-0.03, 0.04), (-0.02, -0.05)))),
    ],
)
def test_a_scene_comes_back_from_its_file_to_the_last_bit(tmp_path, scene):
    scene.save(tmp_path / "scene.json")
    assert Fingerprint(hg.Scene.load(tmp_path / "scene.json")).parts == Fingerprint(scene).parts


TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_an_object_from_a_file_comes_back_while_the_file_is_the_same(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thing.obj").write_text(TETRAHEDRON)
    scene = hg.Scene(object=hg.Body("thing.obj", scale=0.8))
    scene.save("scene.json")
    monkeypatch.chdir("/")
    loaded = hg.Scene.load(tmp_path / "scene.json")
    assert Fingerprint(loaded).parts == Fingerprint(scene).parts
    (tmp_path / "thing.obj").write_text(TETRAHEDRON.replace(".1", ".09"))
    os.utime(tmp_path / "thing.obj", (0, 0))  # MuJoCo keeps meshes by name and second
    with pytest.raises(hg.ResultsError, match=r"thing\.obj has changed"):
        hg.Scene.load(tmp_path / "scene.json")


def test_a_scene_of_a_robot_folder_keeps_its_absolute_path(tmp_path, monkeypatch):
    folder = hg.RobotDescription.load("bhand").xml.parent
    shutil.copytree(folder, tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    hg.Scene(robot="./mine").save("scene.json")
    monkeypatch.chdir("/")
    assert hg.Scene.load(tmp_path / "scene.json").robot == str(tmp_path / "mine")


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"robot": "nobody", "object": {"kind": "Cylinder"}}']
)
def test_a_file_that_holds_no_scene_is_said(tmp_path, text):
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(hg.ResultsError, match=r"scene\.json holds no scene"):
        hg.Scene.load(tmp_path / "scene.json")


def test_a_folder_that_cannot_be_shown_says_what_is_missing(folders, tmp_path):
    with pytest.raises(hg.ResultsError, match="there is no folder"):
        Results.open(tmp_path / "nowhere")
    broken = tmp_path / "broken"
    shutil.copytree(folders / "strict", broken)
    whole = (broken / "probes.parquet").read_bytes()
    (broken / "probes.parquet").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(hg.ResultsError, match="broken cannot be read"):
        Results.open(broken)
    (broken / "scene.json").unlink()
    with pytest.raises(hg.ResultsError, match=r"has no scene\.json.*run again, completes it"):
        Results.open(broken)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.drop_columns(["eps_k"]), "no column 'eps_k'"),
        (lambda rows: rows.drop_columns(["q_wam_j1"]), "no column 'q_wam_j1'"),
        (lambda rows: rows[:0], "no rows"),
    ],
)
def test_a_folder_without_what_is_shown_says_what_is_missing(folders, tmp_path, change, message):
    copy = shutil.copytree(folders / "strict", tmp_path / "copy")
    pq.write_table(change(pq.read_table(copy / "probes.parquet")), copy / "probes.parquet")
    with pytest.raises(hg.ResultsError, match=f"copy cannot be read: it has {message}"):
        Results.open(copy)


def test_a_robot_that_changed_since_is_noticed(folders, tmp_path):
    shutil.copytree(folders / "strict", tmp_path / "old")
    config = json.loads((tmp_path / "old" / "config.json").read_text())
    config["trial"]["scene"]["robot"]["model"] = "another"
    (tmp_path / "old" / "config.json").write_text(json.dumps(config))
    assert not Results.open(tmp_path / "old").same_scene


# ---------------------------------------------------------------- mistakes


def test_a_ghost_of_other_starts_is_refused(folders):
    with socket.create_server(("127.0.0.1", 0)) as taken:  # or it would serve for ever
        port = taken.getsockname()[1]
        with pytest.raises(hg.InputError, match=r"has seed 0, .*other_seed has 1"):
            serve(folders / "strict", folders / "other_seed", port=port)


# ---------------------------------------------------------------- the page, without a browser


@pytest.fixture(scope="module")
def viewer(folders):
    """A page with a ghost beside it, and the server that nobody is connected to."""
    with _quiet_server() as server:
        yield Viewer(server, Results.open(folders / "strict"), Results.open(folders / "paper"))


def test_sliders_reach_from_the_first_trial_and_probe_to_the_last(viewer):
    assert (viewer._trial.min, viewer._trial.max, viewer._trial.value) == (0, TRIALS - 1, 0)
    assert (viewer._probe.min, viewer._probe.max, viewer._probe.value) == (0, PROBES, 0)
    assert viewer._play.value is False


def test_the_numbers_and_curves_of_both_studies_follow_the_sliders(viewer, folders):
    viewer._trial.value, viewer._probe.value = 3, 2
    viewer.refresh()
    rows = [Results.open(folders / name).rows(3) for name in ("strict", "paper")]
    said = viewer._numbers.content.splitlines()
    assert said[0] == "| trial 3, probe 2 |strict|paper (ghost)|" and said[1] == "|---|---|---|"
    cells = [f"{of[2]['eps_f']:.3e} N²" for of in rows]
    assert f"| eps_f |{cells[0]}|{cells[1]}|" in said
    probes, *curves, now = viewer._plot.data
    np.testing.assert_array_equal(probes, np.arange(PROBES + 1))
    due = []
    for of in rows:
        for name, scale in (
            ("eps_f", lambda v: v),
            ("eps_m", lambda v: 1e3 * np.sqrt(v)),
            ("eps_k", lambda v: v),
        ):
            values = [np.nan if row[name] is None else scale(row[name]) for row in of]
            due.append(np.log10(np.maximum(values, 1e-16)))
    np.testing.assert_allclose(curves, due)
    assert np.flatnonzero(np.isfinite(now)).tolist() == [2] and now[2] == 0.0
    # A slider has two ends even where there is one: what lies beyond shows the last.
    viewer._trial.value, viewer._probe.value = TRIALS + 3, PROBES + 3
    viewer.refresh()
    assert viewer._numbers.content.startswith(f"| trial {TRIALS - 1}, probe {PROBES} |")


def test_curves_are_told_apart_by_name_colour_and_dashes(viewer):
    first, *lines, now = viewer._series()
    assert first == {"label": "probe"} and now["label"] == "shown"
    errors = ["ε_f [N²]", "√ε_m [mm·N]", "ε_k [rad]"]
    assert [line["label"] for line in lines] == errors + [f"{error} (ghost)" for error in errors]
    assert [line["stroke"] for line in lines[:3]] == [line["stroke"] for line in lines[3:]]
    assert len({line["stroke"] for line in lines}) == 3
    assert [bool(line["dash"]) for line in lines] == [False] * 3 + [True] * 3


def test_a_trial_is_shown_at_the_probe_that_ended_it(viewer, monkeypatch):
    nothing = dict.fromkeys(("eps_f", "eps_m", "eps_k"))
    outcomes = enumerate(["touch", "gave up: x", None])
    ended = [nothing | {"probe": i, "outcome": why} for i, why in outcomes]
    monkeypatch.setattr(viewer, "_load", lambda results, trial: (None, [], ended))
    viewer.show(2)
    assert (viewer._trial.value, viewer._probe.value) == (2, 1)
    monkeypatch.setattr(viewer, "_load", lambda results, trial: (None, [], ended[2:]))
    viewer.show(1)
    assert (viewer._trial.value, viewer._probe.value) == (1, 0)


def test_the_heading_counts_good_and_secure_trials_and_names_what_changed(viewer, folders):
    results = Results.open(folders / "strict")
    heads = viewer._heading().split("\n\n")
    bad = sum(len(trials) for trials in results.failures.values())
    assert heads[0] == (
        f"**{folders / 'strict'}**: {TRIALS} trials of {PROBES} probes, {TRIALS - bad} good, "
        f"{results.secure} secure, seed 0"
    )
    assert heads[1:] == [f"ghost: **{folders / 'paper'}**, the same starts"]


def test_failures_have_a_button_each_up_to_two_dozen(viewer, monkeypatch):
    class Gui:
        groups: ClassVar = {}

        def add_button_group(self, label, trials):
            self.groups[label] = trials
            return SimpleNamespace(on_click=clicks.append)

    clicks, shown = [], []
    failures = {"error": (), "lost": (1, 4), "not balanced": tuple(range(30))}
    monkeypatch.setattr(viewer, "_results", SimpleNamespace(failures=failures))
    monkeypatch.setattr(viewer, "show", shown.append)
    viewer._list_failures(Gui())
    assert Gui.groups == {
        "lost: 2": ["1", "4"],
        "not balanced: 30, the first 24": [str(i) for i in range(24)],
    }
    clicks[0](SimpleNamespace(target=SimpleNamespace(value="4")))
    assert shown == [4]


def test_playing_steps_through_the_probes_and_begins_again(viewer, monkeypatch):
    seen = []

    def tick(seconds):
        seen.append(viewer._probe.value)
        if len(seen) > 4:
            raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", tick)
    viewer._probe.value, viewer._play.value = PROBES - 1, True
    with pytest.raises(KeyboardInterrupt):
        viewer.play()
    assert seen == [PROBES - 1, PROBES, 0, 1, 2]
    viewer._play.value = False


# ---------------------------------------------------------------- what is refused


def test_a_port_in_use_is_said_and_no_other_is_taken(folders):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(hg.InputError, match=rf"127\.0\.0\.1:{port}: .*in use.*--port"):
            serve(folders / "strict", port=port)


def test_without_viser_the_line_that_installs_it_is_given(folders, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'viser>=1.1.1'$"):
        serve(folders / "strict")
    settings = scenario.Settings(trials=1, probes=1, view=True, out=tmp_path / "out")
    with pytest.raises(MissingExtraError):  # before any work
        scenario.run("cylinder", SCENE, settings)
    assert not (tmp_path / "out").exists()


def test_the_command_answers_a_mistake_in_one_line(tmp_path):
    command = [sys.executable, "-m", "hqp_grasp", "view", str(tmp_path / "nowhere")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr == f"hqp_grasp: there is no folder {tmp_path / 'nowhere'}\n"


# ---------------------------------------------------------------- in a browser


@contextmanager
def served(*arguments):
    """The command as one types it; yields its address."""
    command = [sys.executable, "-m", "hqp_grasp", "view", *map(str, arguments), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield re.search(r"http://127\.0\.0\.1:\d+", process.stdout.readline()).group()
        finally:
            process.terminate()


def choose(opened, trial, probe):
    """Write numbers into the two sliders' boxes."""
    boxes = opened.locator("input.mantine-NumberInput-input").all()
    for box, value in zip(boxes, (trial, probe), strict=True):
        box.fill(str(value))
        box.press("Enter")


def numbers(opened):
    """The table of the row that is shown: {name: cells}; None under the heading."""
    text = opened.locator("table", has_text="outcome").inner_text()
    lines = [line.split("\t") for line in text.splitlines()]
    return {line[0]: line[1:] for line in lines}


def wait_for(opened, heading):
    opened.get_by_text(heading, exact=True).wait_for(timeout=20_000)


@pytest.mark.browser
def test_trial_3_probe_5_shows_the_numbers_of_that_row(folders):
    rows = pq.read_table(folders / "strict" / "probes.parquet").to_pylist()
    row = next(r for r in rows if (r["trial"], r["probe"]) == (3, 5))
    with (
        served(folders / "strict") as address,
        browser.page() as (opened, requests, errors),
    ):
        opened.goto(address)
        browser.wait_until_drawn(opened)
        wait_for(opened, "trial 0, probe 0")
        before = browser.screenshot(opened)
        choose(opened, 3, 5)
        wait_for(opened, "trial 3, probe 5")
        shown = numbers(opened)
        after = browser.screenshot(opened)
    assert shown["outcome"] == ["touch"]
    assert shown["eps_f"] == [f"{row['eps_f']:.3e} N²"]
    assert shown["eps_m"] == [f"{row['eps_m']:.3e} (N·m)²"]
    assert shown["adduction_deg"] == [f"{row['adduction_deg']:.2f}°"]
    half = np.s_[:, 320:700]  # the scene, clear of controls
    assert (np.abs(before[half] - after[half]) > 30).any(axis=2).mean() > 0.05
    assert errors == []
    assert all(url.startswith((address, f"blob:{address}", "data:")) for url in requests)


@pytest.mark.browser
def test_one_click_shows_a_failure_and_the_ghost_stands_beside_it(folders):
    """The paper's form with six probes: most trials are not balanced yet."""
    bad = Results.open(folders / "paper").failures["not balanced"]
    assert bad
    rows = pq.read_table(folders / "strict" / "probes.parquet").to_pylist()
    row = next(r for r in rows if (r["trial"], r["probe"]) == (bad[-1], PROBES))
    with (
        served(folders / "paper", "--compare", folders / "strict") as address,
        browser.page() as (opened, _, errors),
    ):
        opened.goto(address)
        browser.wait_until_drawn(opened)
        opened.get_by_role("button", name=str(bad[-1]), exact=True).click()
        wait_for(opened, f"trial {bad[-1]}, probe {PROBES}")
        shown = numbers(opened)
        picture = browser.screenshot(opened)
    assert shown["eps_f"][1] == f"{row['eps_f']:.3e} N²"
    red, _, blue = picture[:, 320:700].transpose(2, 0, 1)
    assert ((blue > red + 40) & (blue > 150)).mean() > 0.01  # the ghost
    assert errors == []
