"""The replay: one file that shows what was felt, played by a browser from the disk."""

import dataclasses
import re
import subprocess
import sys
import threading
import time

import mujoco
import numpy as np
import pyarrow as pa
import pytest

import hqp_grasp as hg
from hqp_grasp.errors import MissingExtraError
from hqp_grasp.experiments import scenario
from hqp_grasp.experiments.replay import (
    FORCE_COLOUR,
    GREY,
    NORMAL_COLOUR,
    Frame,
    camera,
    describe,
    frames_of,
    frames_of_pick,
    frames_of_rows,
    placed,
    rows_of,
    shapes,
    write_replay,
)
from hqp_grasp.grasp import Touch

pytest.importorskip("viser", reason="no viser: pip install 'hqp_grasp[view]'")
import browser
from recording import messages, scene_at

ARROW = 0.04

PROBES = 60
SCENE = hg.Scene()
ROUNDED = 1e-6  # [m] float32 in the file


def without_a_miss(trial):
    """The first record in which every probe touched."""
    records = (trial.run((0, i)) for i in range(30))
    return next(r for r in records if all(row["in_contact"] for row in r.rows))


@pytest.fixture(scope="module")
def record():
    stack = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
    return without_a_miss(hg.Trial(SCENE, stack, probes=PROBES))


@pytest.fixture(scope="module")
def written(record, tmp_path_factory):
    """The replay of that record: its file, and how long it took to write [s]."""
    path = tmp_path_factory.mktemp("replay") / "replay.html"
    write_replay(SCENE, record, path.with_name("warm.html"))  # imports, fonts
    begin = time.perf_counter()
    write_replay(SCENE, record, path, "cylinder, trial 0")
    return path, time.perf_counter() - begin


@pytest.fixture(scope="module")
def played(written):
    return messages(written[0].read_text(encoding="utf-8"))


def grasp_at(record, probe):
    """What was felt at a probe, or last before it."""
    touches = sum(bool(row["in_contact"]) for row in record.rows[: probe + 1])
    return record.grasps[touches - 1]


def lost(record, at):
    """The same record, its touch lost from probe `at` on."""
    nothing = dict.fromkeys(record.rows[0]) | {"in_contact": False, "other_links": ""}
    miss = nothing | {"outcome": "a finger closed without touching (f2)"}
    rows = (*record.rows[:at], miss, *[nothing] * (len(record.rows) - at - 1))
    touches = sum(bool(row["in_contact"]) for row in record.rows[:at])
    return dataclasses.replace(record, rows=rows, grasps=record.grasps[:touches])


def table_of(record, trial=0):
    """The record as a results folder holds it."""
    table = record.to_table()
    return table.add_column(0, "trial", pa.array([trial] * len(table)))


# ---------------------------------------------------------------- frames


def test_a_frame_holds_what_the_probe_felt(record):
    for probe, (frame, row) in enumerate(zip(frames_of(record), record.rows, strict=True)):
        grasp = grasp_at(record, probe)
        assert np.array_equal(frame.q, grasp.q)
        assert np.array_equal(frame.positions, grasp.positions)
        assert np.array_equal(frame.normals, grasp.normals)
        assert frame.touched == row["in_contact"] and frame.outcome == row["outcome"]
        assert not frame.touched or frame.errors["eps_f"] == row["eps_f"]


@pytest.mark.parametrize("ended", [False, True])
def test_stored_rows_give_the_same_frames_as_the_record(record, ended):
    record = lost(record, 7) if ended else record
    stored = frames_of_rows(rows_of(table_of(record), 0), record.joints)
    for frame, same in zip(frames_of(record), stored, strict=True):
        assert np.array_equal(frame.q, same.q) and np.array_equal(frame.normals, same.normals)
        assert np.array_equal(frame.positions, same.positions)
        assert (frame.outcome, frame.touched) == (same.outcome, same.touched)
        assert frame.errors == pytest.approx(same.errors, nan_ok=True)


def test_a_probe_without_touch_keeps_the_last_grasp_and_says_why(record):
    frames = frames_of(lost(record, 7))
    assert len(frames) == PROBES + 1
    for frame in frames[7:]:
        assert not frame.touched and np.array_equal(frame.q, grasp_at(record, 6).q)
        assert frame.outcome == "a finger closed without touching (f2)"
        assert np.isnan(frame.errors["eps_f"])


def test_rows_without_contact_columns_show_the_robot_alone(record):
    rows = [
        {name: value for name, value in row.items() if not name.startswith("contact_")}
        for row in rows_of(table_of(record), 0)
    ]
    frames = frames_of_rows(rows, record.joints)
    assert frames[0].positions.shape == (0, 3) and np.array_equal(frames[0].q, record.grasps[0].q)


def test_what_cannot_be_drawn_is_said(record):
    with pytest.raises(hg.ResultsError, match="q_elbow"):
        frames_of_rows(rows_of(table_of(record), 0), [*record.joints, "elbow"])
    with pytest.raises(hg.InputError, match="never touched"):
        frames_of(lost(record, 0))
    with pytest.raises(hg.InputError, match="no trial 5; trials are 0 … 0"):
        rows_of(table_of(record), 5)


def test_a_contact_that_one_finger_alone_misses_leaves_no_gap(record):
    rows = rows_of(table_of(record), 0)
    rows[0] |= {name: None for name in rows[0] if name.startswith("contact_2_")}
    (frame, *_) = frames_of_rows(rows, record.joints)
    assert np.array_equal(frame.positions, record.grasps[0].positions[[0, 2]])


# ---------------------------------------------------------------- a hand without an arm


@pytest.fixture(scope="module")
def floating():
    """A hand without an arm, placed by the draw of its trial, and that trial."""
    scene = hg.Scene(robot="bhand")
    return scene, without_a_miss(hg.Trial(scene, hg.stack_of("fmk"), probes=3))


def test_a_hand_without_an_arm_is_drawn_where_it_touched(floating):
    scene, record = floating
    robot = placed(scene, frames_of(record)).articulated
    for grasp in record.grasps:
        tips = grasp.positions + robot.tip_radius[:, None] * grasp.normals
        assert robot.centers(grasp.q) == pytest.approx(tips, abs=1e-6)
    far = np.abs(scene.articulated.centers(record.grasps[0].q) - record.grasps[0].positions)
    assert far.max() > 0.1  # it had to be moved


def test_a_robot_with_an_arm_stays_where_it_is(record):
    assert placed(SCENE, frames_of(record)) is SCENE


def test_a_hand_that_does_not_fit_its_contacts_is_not_drawn(floating):
    scene, record = floating
    frame = frames_of(record)[0]
    with pytest.raises(hg.InputError, match="do not fit their contacts"):
        placed(scene, [dataclasses.replace(frame, positions=1.1 * frame.positions)])
    two = dataclasses.replace(frame, positions=frame.positions[:2], normals=frame.normals[:2])
    with pytest.raises(hg.InputError, match="3 at least; 2 are stored"):
        placed(scene, [two])


# ---------------------------------------------------------------- shapes

ONE_OF_EACH = """
<mujoco>
  <asset><mesh name="tetra" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body><geom type="sphere" size=".1" pos="0 0 .3"/></body>
    <body><geom type="capsule" size=".05 .1"/></body>
    <body><geom type="cylinder" size=".05 .1" euler="90 0 0"/></body>
    <body><geom type="box" size=".1 .2 .3"/></body>
    <body><geom type="ellipsoid" size=".1 .2 .3"/></body>
    <body><geom type="mesh" mesh="tetra"/></body>
    <body><geom type="box" size="1 1 1" group="3"/></body>
    <body><geom type="box" size="1 1 1" rgba="1 0 0 0"/></body>
  </worldbody>
</mujoco>
"""


def test_every_kind_of_geom_has_its_size_and_place():
    found = {s.body: s for s in shapes(mujoco.MjModel.from_xml_string(ONE_OF_EACH))}
    boxes = {
        1: ([-0.1, -0.1, 0.2], [0.1, 0.1, 0.4]),
        2: ([-0.05, -0.05, -0.15], [0.05, 0.05, 0.15]),
        3: ([-0.05, -0.1, -0.05], [0.05, 0.1, 0.05]),
        4: ([-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]),
        5: ([-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]),
        6: ([0.0, 0.0, 0.0], [0.1, 0.1, 0.1]),
    }
    assert sorted(found) == sorted(boxes)  # neither plane, nor hidden group, nor transparent
    for body, (low, high) in boxes.items():
        # A round surface of flat faces stays up to a hundredth inside.
        assert found[body].vertices.min(axis=0) == pytest.approx(low, abs=2e-3)
        assert found[body].vertices.max(axis=0) == pytest.approx(high, abs=2e-3)


def test_a_prism_is_drawn_with_its_own_corners():
    prism = hg.Prism.regular(6, 0.05)
    model = hg.Scene(object=prism).model
    shape = next(s for s in shapes(model) if model.body(s.body).name == "object")
    corners = np.unique(shape.vertices.round(6), axis=0)
    wanted = np.unique(
        np.round([(x, y, z) for x, y in prism.polygon for z in (-0.06, 0.06)], 6), axis=0
    )
    distance = np.linalg.norm(corners[:, None] - wanted[None], axis=2)
    assert distance.min(axis=0).max() < 1e-5


# ---------------------------------------------------------------- the file


def test_the_file_is_small_and_quickly_written(written):
    path, seconds = written
    assert path.stat().st_size <= 3e6
    assert seconds <= 5.0
    assert not list(path.parent.glob("*.part"))


def test_the_page_refers_to_no_other_file(written):
    text = written[0].read_text(encoding="utf-8")
    assert "<title>cylinder, trial 0</title>" in text
    markup = re.sub(r"<(script|style)\b.*?</\1>", "", text, flags=re.DOTALL)
    assert "<body" in markup
    assert not re.search(r"\b(src|href)\s*=\s*[\"']?(https?:)?//", markup)
    assert not re.search(r"<script[^>]+\bsrc=", text)
    assert not re.search(r"@import|url\(\s*[\"']?https?:", text)


def test_the_time_bar_counts_probes(played):
    duration, _ = played
    assert duration == PROBES + 1


@pytest.mark.parametrize("probe", [0, 3, PROBES])
def test_arrows_start_at_the_contacts_of_the_probe(record, played, probe):
    nodes, grasp = scene_at(played[1], probe + 0.5), grasp_at(record, probe)
    for name, vector in (("normals", 1.25 * grasp.normals), ("forces", -grasp.normals)):
        arrows = nodes[f"/hand/{name}"]["points"].reshape(-1, 2, 3)
        assert arrows[:, 0] == pytest.approx(grasp.positions, abs=ROUNDED)
        assert arrows[:, 1] == pytest.approx(grasp.positions + ARROW * vector, abs=ROUNDED)
    touched = record.rows[probe]["in_contact"]
    assert tuple(nodes["/hand/normals"]["colors"]) == (NORMAL_COLOUR if touched else GREY)
    assert tuple(nodes["/hand/forces"]["colors"]) == (FORCE_COLOUR if touched else GREY)


def test_the_net_force_is_drawn_until_it_vanishes(record, played):
    arrow = scene_at(played[1], 0.5)["/hand/net_force"]["points"].reshape(-1, 2, 3)
    grasp = record.grasps[0]
    assert arrow[0, 0] == pytest.approx(grasp.positions.mean(axis=0), abs=ROUNDED)
    assert arrow[0, 1] - arrow[0, 0] == pytest.approx(
        -ARROW * grasp.normals.sum(axis=0), abs=ROUNDED
    )
    assert len(scene_at(played[1], PROBES + 0.5)["/hand/net_force"]["points"]) == 0


def test_all_points_felt_so_far_are_there(record, played):
    for probe in (0, 5, PROBES):
        points = scene_at(played[1], probe + 0.5)["/hand/felt"]["points"].reshape(-1, 3)
        touches = sum(bool(row["in_contact"]) for row in record.rows[: probe + 1])
        felt = np.concatenate([g.positions for g in record.grasps[:touches]])
        assert points == pytest.approx(felt, abs=ROUNDED)


def test_every_body_is_where_the_joint_angles_put_it(record, played):
    model, robot = SCENE.model, SCENE.articulated
    for probe in (0, 4, PROBES):
        data = mujoco.MjData(model)
        robot.place(data, grasp_at(record, probe).q)
        nodes = scene_at(played[1], probe + 0.5)
        for body in range(1, model.nbody):
            node = {"position": [0, 0, 0], "wxyz": [1, 0, 0, 0]} | nodes[f"/hand/body_{body}"]
            # viser leaves a pose as it is where np.allclose sees no change: to 1e-5.
            assert np.allclose(node["position"], data.xpos[body], rtol=2e-5)
            assert np.allclose(node["wxyz"], data.xquat[body], rtol=2e-5)


def test_frames_of_bodies_are_places_and_not_drawn(played):
    nodes = scene_at(played[1], 0.5)
    drawn = {name: node for name, node in nodes.items() if name.startswith("/hand")}
    frames = [name for name, node in drawn.items() if "show_axes" in node]
    assert len(frames) >= SCENE.model.nbody
    assert [name for name in frames if nodes[name]["show_axes"]] == []


def test_the_errors_of_the_probe_stand_beside_it(record, played):
    text = scene_at(played[1], 3.5)["/errors/numbers"]["text"]
    assert "cylinder, trial 0" in text and f"probe 3 of {PROBES}: touch" in text
    assert f"{record.rows[3]['eps_f']:.2e} N²" in text
    assert f"{1e3 * record.rows[3]['eps_m'] ** 0.5:.2e} mm·N" in text
    assert f"holds if µ ≥ {record.rows[3]['friction_demand']:.2f}" in text


def test_what_is_held_is_drawn_where_it_is_with_its_forces_and_their_sum(record, tmp_path):
    """Six millimetres a newton, towards the contacts; what is held has no errors."""
    touches = [Touch(grasp.q, grasp) for grasp in record.grasps[:2]]
    x, f = touches[1].felt.positions, np.array([[0, 0, 2.0], [1.0, 0, 0], [0, -3.0, 0]])
    contacts = np.column_stack([x, touches[1].felt.normals, f]).ravel().tolist()
    place = [0.7, 0.1, 0.3, 0.0, 1.0, 0.0, 0.0]
    look = {"time": 1.0, "phase": "lift", "load": 4.5, "strength": 6.0, "normal": [2.0, 1.0, 3.0]}
    look |= {"contacts": contacts, "q": touches[1].felt.q.tolist(), "object": place}
    blind = look | {"time": 1.25, "contacts": [], "q": [], "normal": []}
    frames = frames_of_pick(record.rows[:2], touches, [look, blind, blind | {"time": 1.75}])
    assert [frame.held and frame.held.duration for frame in frames] == [None, None, 0.25, 0.5, 0.0]
    np.testing.assert_array_equal(frames[3].q, frames[2].q)  # where nothing was felt: as before
    assert describe(frames, 2) == [
        "lift: 4.50 N carried",
        "asked for 6.0 N a contact, in the mean",
        "felt 2.0, 1.0, 3.0 N",
        "forces drawn 6 mm a newton",
    ]
    assert (
        describe(frames, 3)[2].strip() == "felt" and describe(frames, 1)[0] == "probe 1 of 1: touch"
    )
    write_replay(SCENE, frames, tmp_path / "held.html")
    duration, told = messages((tmp_path / "held.html").read_text(encoding="utf-8"))
    assert duration == pytest.approx(2.75)
    nodes = scene_at(told, 2.1)
    arrows = nodes["/hand/forces"]["points"].reshape(-1, 2, 3)
    assert arrows[:, 1] == pytest.approx(x, abs=ROUNDED)
    assert arrows[:, 1] - arrows[:, 0] == pytest.approx(0.006 * f, abs=ROUNDED)
    net = nodes["/hand/net_force"]["points"].reshape(-1, 2, 3)[0]
    assert net[0] == pytest.approx(x.mean(axis=0), abs=ROUNDED)
    assert net[1] - net[0] == pytest.approx(0.006 * f.sum(axis=0), abs=ROUNDED)
    assert len(nodes["/hand/normals"]["points"]) == len(nodes["/hand/felt"]["points"]) == 0
    thing = nodes[f"/hand/body_{SCENE.model.body('object').id}"]
    assert [*thing["position"], *thing["wxyz"]] == pytest.approx(place, abs=ROUNDED)
    assert len(scene_at(told, 2.3)["/hand/forces"]["points"]) == 0


def test_one_looks_at_hand_and_object_from_the_side():
    q = SCENE.articulated.home
    palm = SCENE.articulated.palm(q)[0]
    view = camera(SCENE, q)
    np.testing.assert_allclose(view.middle, (palm + SCENE.position) / 2.0)
    assert view.size == pytest.approx(max(0.3, 2.0 * np.linalg.norm(palm - SCENE.position)))
    right, up, back = view.axes
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(right, up), back, atol=1e-12)
    assert right[2] == pytest.approx(0.0) and up[2] > 0.0 and back[1] < 0.0


def test_a_lost_grasp_turns_grey_and_the_reason_is_written(record, tmp_path):
    write_replay(SCENE, lost(record, 7), tmp_path / "lost.html")
    nodes = scene_at(messages((tmp_path / "lost.html").read_text(encoding="utf-8"))[1], 7.5)
    arrows = nodes["/hand/normals"]["points"].reshape(-1, 2, 3)
    assert arrows[:, 0] == pytest.approx(grasp_at(record, 6).positions, abs=ROUNDED)
    assert tuple(nodes["/hand/normals"]["colors"]) == GREY
    assert "a finger closed without touching (f2)" in nodes["/errors/numbers"]["text"]


def test_writing_says_nothing_and_leaves_no_server_behind(record, tmp_path, capsys):
    before = threading.active_count()
    write_replay(SCENE, frames_of(record)[:2], tmp_path / "short.html")
    assert "".join(capsys.readouterr()) == ""
    assert threading.active_count() <= before


# ---------------------------------------------------------------- without viser


def test_importing_hqp_grasp_needs_no_viewer():
    code = "import sys, hqp_grasp, hqp_grasp.experiments.scenario\n"
    code += "assert not {'viser', 'trimesh'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_viser_the_line_that_installs_it_is_given(record, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'viser>=1.1.1'$"):
        write_replay(SCENE, record, tmp_path / "replay.html")
    assert not list(tmp_path.iterdir())


SMALL = scenario.Settings(trials=2, probes=3, jobs=1)


def test_a_scenario_without_viser_ends_as_before(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    settings = dataclasses.replace(SMALL, out=tmp_path)
    table = scenario.run("cylinder", SCENE, settings)
    said = capsys.readouterr().out
    assert table.num_rows == 8 and (tmp_path / "convergence.png").is_file()
    assert "pip install 'viser>=1.1.1'" in said.splitlines()[-1]
    assert not (tmp_path / "replay.html").exists()


def test_a_scenario_leaves_the_replay_of_the_trial_asked_for(tmp_path, capsys):
    scenario.run("cylinder", SCENE, dataclasses.replace(SMALL, out=tmp_path, replay=1))
    assert f"replay   {tmp_path / 'replay.html'}" in capsys.readouterr().out
    page = (tmp_path / "replay.html").read_text(encoding="utf-8")
    assert "<title>cylinder, trial 1</title>" in page
    stack = hg.stack_of("fmk").within(hg.StepLimit(), hg.ConfigurationLimit(SCENE.articulated))
    grasp = hg.Trial(SCENE, stack, probes=3).run((0, 1)).grasps[0]
    palm = SCENE.model.body("bhand_palm").id
    position, _ = SCENE.articulated.bodies(grasp.q)
    drawn = scene_at(messages(page)[1], 0.5)[f"/hand/body_{palm}"]["position"]
    assert drawn == pytest.approx(position[palm])


def test_a_replay_of_a_trial_that_is_not_run_is_refused_before_any_work(tmp_path):
    with pytest.raises(hg.InputError, match=r"--replay takes a trial, 0 … 1; got 2"):
        scenario.run("cylinder", SCENE, dataclasses.replace(SMALL, out=tmp_path / "a", replay=2))
    assert not (tmp_path / "a").exists()


# ---------------------------------------------------------------- in a browser


def on_screen(told, height):
    """A function from world points (k, 3) to pixels (k, 2), by the file's own camera."""
    said = {m["type"]: m for _, m in told}
    eye = np.array(said["SetCameraPositionMessage"]["position"])
    back = eye - np.array(said["SetCameraLookAtMessage"]["look_at"])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(back, right), back])
    focal = 0.5 * height / np.tan(0.5 * said["SetCameraFovMessage"]["fov"])

    def project(points):
        x, y, z = axes @ (np.atleast_2d(points) - eye).T
        middle = 0.5 * browser.SIZE["width"], 0.5 * height
        return np.column_stack([middle[0] - focal * x / z, middle[1] + focal * y / z])

    return project


def around(picture, pixel, reach=7):
    """The colours near a pixel (m, 3)."""
    x, y = np.round(pixel).astype(int)
    return picture[y - reach : y + reach + 1, x - reach : x + reach + 1].reshape(-1, 3)


def share(colours, red, green, blue):
    """How many of the colours lie within three ranges."""
    ranges = np.array([red, green, blue])
    return ((colours >= ranges[:, 0]) & (colours <= ranges[:, 1])).all(axis=1).mean()


# Two postures whose touches hide neither tips nor arrows from the camera [rad].
POSTURES = (
    (0.421, 0.907, -0.45, 1.975, 0.56, -0.248, 0.476, 0.966, 0.958, 1.469, 0.973),
    (0.779, 1.28, -1.117, 1.71, 0.616, 0.35, 1.391, 1.262, 0.971, 1.517, 0.901),
)


@pytest.fixture(scope="module")
def touches():
    """What the hand feels in these two postures."""
    probe = hg.GeometricProbe(SCENE)
    return [probe.touch(np.array(q)) for q in POSTURES]


@pytest.fixture(scope="module")
def seen(touches, tmp_path_factory):
    """Pictures of two probes and the first again; the canvas's height; requests; errors; file."""
    path = tmp_path_factory.mktemp("seen") / "replay.html"
    errors = {"eps_f": 1.0, "eps_m": 1.0, "eps_k": 1.0}
    frames = [Frame(g.q, g.positions, g.normals, errors, "touch", True) for g in touches]
    write_replay(SCENE, frames, path)
    pictures = []
    with browser.page(offline=True) as (opened, requests, errors):
        opened.goto(path.as_uri())
        browser.wait_until_drawn(opened)
        height = opened.evaluate("document.querySelector('canvas').clientHeight")
        for second in ("1.5", "0.5", "1.5", "0.5"):  # the first one, until all is loaded
            opened.locator("input").first.fill(second)
            pictures.append(browser.screenshot(opened))
    first, second, again = pictures[1:]
    return (first, second, again), height, requests, errors, path


@pytest.mark.browser
def test_the_file_plays_from_the_disk_and_asks_no_other_host(seen):
    _, _, requests, errors, path = seen
    assert requests[0] == path.as_uri()
    assert all(url.startswith(("file:", "blob:", "data:")) for url in requests)
    assert errors == []


@pytest.mark.browser
def test_robot_object_and_arrows_show_where_they_should(seen, touches):
    (picture, *_), height, *_, path = seen
    project, grasp = on_screen(messages(path.read_text(encoding="utf-8"))[1], height), touches[0]
    centres = SCENE.articulated.centers(grasp.q)
    for i in range(grasp.k):
        tip = around(picture, project(centres[i])[0], 4)
        assert share(tip, (150, 255), (30, 140), (0, 110)) > 0.5  # the robot's orange tips
        p, n = grasp.positions[i], grasp.normals[i]
        outside = around(picture, project(p + 1.1 * ARROW * n)[0], 4)
        assert share(outside, (150, 255), (40, 160), (120, 240)) > 0.1  # the normal, magenta
        inside = around(picture, project(p - 0.8 * ARROW * n)[0], 4)
        assert share(inside, (0, 160), (60, 180), (130, 255)) > 0.1  # the force, blue
    below = around(picture, project(np.array(SCENE.position) - [0, 0, 0.04])[0])
    assert share(below, (200, 255), (170, 240), (120, 220)) > 0.9  # the object, see-through
    palm, _ = SCENE.articulated.palm(grasp.q)
    # Nothing but background where nothing is: left of the hand by half a metre's worth of pixels.
    assert share(around(picture, project(palm)[0] - [290, -200]), *[(250, 255)] * 3) == 1.0


@pytest.mark.browser
def test_moving_along_the_time_bar_moves_the_hand_and_back(seen, touches):
    (first, later, again), height, *_, path = seen
    project = on_screen(messages(path.read_text(encoding="utf-8"))[1], height)
    for grasp in touches:
        x, y = project(SCENE.articulated.palm(grasp.q)[0])[0].astype(int)
        region = np.s_[y - 60 : y + 60, x - 60 : x + 60]
        changed = (np.abs(first[region] - later[region]) > 30).any(axis=2).mean()
        assert changed > 0.3
    bottom = int(height)
    assert np.array_equal(first[:bottom], again[:bottom])
