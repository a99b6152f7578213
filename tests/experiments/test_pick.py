"""Picks: found by touch, held, lifted, set down; and what becomes of it when something breaks."""

import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import hqp_grasp as hg
from hqp_grasp.errors import InputError, ModelError
from hqp_grasp.experiments.lifting import lift
from hqp_grasp.experiments.pick import COLUMNS, LOOK
from hqp_grasp.experiments.picking import PickSettings, kinds, pick_of, run, summary
from hqp_grasp.experiments.plots import picked_figure
from hqp_grasp.experiments.replay import frames_of_pick
from hqp_grasp.world.imperfections import Fault

SCENE = hg.Scene(object=hg.Cylinder(0.05))
STACK = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
SEED = (41, 0)


def pick(preset="loadcell", faults=(), friction=0.5, **physics):
    about = hg.Imperfections.preset(preset, faults=faults)
    world = hg.Physics(
        **{"support": "pedestal", "mass": 0.5, "timestep": 0.004, "imperfections": about} | physics
    )
    return hg.Pick(hg.Trial(SCENE, STACK, probes=30, probe=world), friction=friction)


@pytest.fixture(scope="module")
def done():
    return pick().run(SEED)


def when(done, phase):
    """When [s] a phase of a pick began."""
    return next(look["time"] for look in done.looks if look["phase"] == phase)


# ---------------------------------------------------------------- as it should be


def test_what_stood_is_lifted_weighed_and_stands_again(done):
    row = done.row
    assert row["lifted"] and row["set_down"] and not row["reason"] and not row["error"]
    assert row["felt_weight"] == pytest.approx(0.5, rel=0.03)
    assert 0.09 < row["height"] < 0.13
    assert row["slip_mm"] < 1.0 and row["limit_violation"] == 0.0
    assert repr(done) == "<Pick of seed (41, 0): lifted and set down>"


def test_a_row_has_every_column_with_its_unit_and_the_looks(done):
    table = done.to_table()
    assert table.column_names == [*COLUMNS, "looks"] and table.num_rows == 1
    assert all(table.schema.field(name).metadata[b"meaning"] for name in table.column_names)
    (looks,) = table["looks"].to_pylist()
    assert set(looks[0]) == set(LOOK)
    phases = list(dict.fromkeys(look["phase"] for look in looks))
    assert phases == ["tighten", "loosen", "lift", "hold", "shake", "lower"]


def test_the_hand_presses_harder_once_it_carries(done):
    strength = {look["phase"]: look["strength"] for look in done.looks}
    assert strength["tighten"] == 5.0 < strength["hold"]


def test_a_replay_shows_the_touches_and_then_the_carry_with_the_object_moving(done):
    frames = frames_of_pick(done.told, done.touches, done.looks)
    assert len(frames) == len(done.touches) + len(done.looks)
    held = [frame.held for frame in frames if frame.held is not None]
    rose = max(h.place[2] for h in held) - held[0].place[2]
    assert rose == pytest.approx(done.row["height"], abs=5e-3)
    middle = held[len(held) // 2]
    assert middle.forces[:, 2].sum() == pytest.approx(0.5 * 9.81, rel=0.1)


def test_the_figure_has_a_curve_for_each_contact_and_the_load(done):
    (axes,) = picked_figure(done.looks, "a pick").axes
    assert len(axes.get_lines()) == 5
    assert {text.get_text() for text in axes.texts} >= {"tighten", "lift", "lower"}


# ---------------------------------------------------------------- what breaks


@pytest.mark.parametrize(
    ("about", "options"),
    [
        ("friction of 0.4, 0.6 believed", {"friction": 0.6, "actual": 0.4}),
        ("1 kg", {"mass": 1.0}),
        ("no noise", {"preset": None}),
    ],
)
def test_it_is_lifted_and_set_down_all_the_same(about, options):
    options = dict(options)
    actual = options.pop("actual", 0.6)
    p = pick(**options)
    p = replace(p, trial=replace(p.trial, probe=replace(p.trial.probe, friction=actual)))
    row = p.attempt(SEED).row
    assert row["lifted"] and row["set_down"], row


@pytest.mark.parametrize(("kind", "phase"), [("freeze", "hold"), ("dropout", "lift")])
def test_a_sensor_that_breaks_while_it_is_held_sets_the_object_down_and_says_so(done, kind, phase):
    fault = Fault(kind, 1, begin=when(done, phase) + 0.3)
    row = pick(faults=(fault,)).attempt(SEED).row
    assert row["set_down"] and row["error"] is None
    assert "finger_2" in row["reason"]


def test_a_contact_that_comes_off_is_told():
    def slippery(moment):
        if moment.phase == "lift":
            hand.model.geom_friction[:, 0] = 0.02

    p = pick(preset=None)
    began = p.trial.begin(SEED)
    hand, last = began.hand, p._find(began)[0][-1].felt
    told = lift(began.touching, p._hold(SCENE), last, 0.1, slippery)
    assert not told.lifted and told.reason


class Weak:
    """A driver that cannot press, and counts what moves it."""

    def __init__(self, hand):
        self._hand, self.limits, self.moved = hand, replace(hand.limits, grip=0.0), 0

    def __getattr__(self, name):
        return getattr(self._hand, name)

    def move(self, q, duration):
        self.moved += 1
        return self._hand.move(q, duration)

    def press(self, torque):
        self.moved += 1
        self._hand.press(torque)

    def carry(self, q, duration):
        self.moved += 1
        return self._hand.carry(q, duration)


def test_a_driver_that_cannot_press_is_refused_before_anything_moves():
    p = pick(preset=None)
    began = p.trial.begin(SEED)
    weak = Weak(began.hand)
    probe = hg.PhysicalProbe(weak, SCENE.articulated)
    with pytest.raises(InputError, match="cannot press"):
        lift(probe, p._hold(SCENE), began.felt)
    assert weak.moved == 0


def trial(**changes):
    return hg.Trial(**{"scene": SCENE, "stack": STACK, "probe": hg.Physics()} | changes)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: hg.Pick(trial()), "that can be lifted"),
        (lambda: hg.Pick(trial(probe="geometric")), "that can be lifted"),
        (lambda: replace(pick(), force=30.0), "above the 15 N"),
        (lambda: replace(pick(), friction=0.0), "above 0"),
        (lambda: replace(pick(), height=-0.1), "above 0"),
        (
            lambda: hg.Pick(
                trial(scene=replace(SCENE, robot="bhand"), probe=hg.Physics(support="pedestal"))
            ),
            "no arm",
        ),
    ],
)
def test_what_cannot_be_lifted_is_refused_at_once(make, says):
    with pytest.raises((InputError, ModelError), match=says):
        make()


def test_what_ends_a_pick_is_its_rows_error(monkeypatch):
    def broken(*_):
        raise RuntimeError("cut")

    monkeypatch.setattr(hg.SimulatedHand, "wait", broken)
    ended = pick().attempt(SEED)
    assert ended.row["error"] == "RuntimeError: cut" and not ended.row["lifted"]
    assert ended.to_table().num_rows == 1


# ---------------------------------------------------------------- many, and the command


def test_a_study_of_picks_resumes_where_it_was_and_a_pick_is_a_function_of_its_seed(tmp_path, done):
    first = hg.Study(pick(), trials=1, seed=41).run(tmp_path)
    (again,) = first.to_pylist()
    assert {name: again[name] for name in COLUMNS} == done.row
    assert again["looks"] == [dict(look) for look in done.looks]
    stamp = next((tmp_path / "parts").iterdir()).stat().st_mtime_ns
    both = hg.Study(pick(), trials=2, seed=41).run(tmp_path)
    assert both.slice(0, 1).equals(first) and both.num_rows == 2
    assert stamp in {part.stat().st_mtime_ns for part in (tmp_path / "parts").iterdir()}


def test_the_command_picks_and_says_what_came_of_it(tmp_path):
    command = [sys.executable, "-m", "hqp_grasp", "pick", "cylinder", "--trials", "1", "--jobs"]
    command += ["1", "--seed", "41", "--mass", "0.3", "--actual-friction", "0.5", "--out", "there"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    table = pq.read_table(tmp_path / "there" / "picks.parquet")
    assert summary(table.drop_columns("looks"), 0.3) in ran.stdout
    assert "lifted   1 of 1" in ran.stdout and kinds(table) == {}
    assert table["felt_weight"][0].as_py() == pytest.approx(0.3, rel=0.03)
    assert (tmp_path / "there" / "pick.png").read_bytes().startswith(b"\x89PNG")
    replay = tmp_path / "there" / "replay.html"
    if find_spec("viser"):
        assert replay.stat().st_size > 1e5
    else:
        assert not replay.exists() and "replay   none: " in ran.stdout and "viser" in ran.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nothing"], "unknown scenario"),
        (["cylinder", "--robot", "bhand"], "no arm"),
        (["cylinder", "--mass", "0"], "mass"),
        (["cylinder", "--friction", "-1"], "friction"),
        (["prism", "--corners", "missing.csv"], "missing.csv"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(monkeypatch, tmp_path, arguments, says):
    from hqp_grasp.__main__ import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["hqp_grasp", "pick", *arguments])
    with pytest.raises(SystemExit, match=says):
        main()
    assert not list(tmp_path.iterdir())


def test_failures_are_told_by_kind(done):
    rows = [
        {"lifted": False, "set_down": True, "reason": "a contact uses friction of 0.6, 0.5 is"},
        {"lifted": True, "set_down": False, "reason": None},
        {"lifted": False, "set_down": False, "error": "SolverError: x"},
    ]
    table = pa.Table.from_pylist(
        [done.row | row | {"trial": i} for i, row in enumerate(rows)],
    )
    assert kinds(table) == {
        "not lifted": [0],
        "not where it stood": [1],
        "ended by SolverError": [2],
    }
    said = summary(table, 0.5)
    assert "1 × a contact uses friction of\n" in said and "1 × SolverError" in said
    assert np.isfinite(done.row["slip_mm"])


def test_a_summary_tells_medians_and_the_most_and_reasons_without_their_figures(done):
    rows = [
        {"lifted": True, "set_down": True, "felt_weight": 0.51, "sum_normal": 30.0, "slip_mm": 0.5}
        | {"slip_deg": 0.25, "touches": 10, "limit_violation": 0.0, "reason": None},
        {"lifted": True, "set_down": False, "felt_weight": 0.45, "sum_normal": 41.0, "slip_mm": 2.0}
        | {"slip_deg": 1.0, "touches": 7, "limit_violation": 1e-3, "reason": "it tilts, by 3 mm"},
        {"lifted": False, "set_down": False, "felt_weight": None, "sum_normal": 20.0}
        | {"slip_mm": None, "slip_deg": None, "touches": 9, "reason": "it tilts, by 5 mm"},
        {"lifted": False, "set_down": False, "felt_weight": 0.5, "error": "SolverError: x"},
    ]
    none = dict.fromkeys(COLUMNS)
    table = pa.Table.from_pylist([none | row | {"trial": i} for i, row in enumerate(rows)])
    assert summary(table, 0.5).splitlines()[1:] == [
        "lifted   2 of 4",
        "set down 1 of 4 within 1 cm of where it stood",
        "weight   0.500 kg felt in the median, of 0.5; off by 2.0% in the median, 10.0% at most",
        "forces   30.0 N of normal force in the median, 41.0 at most",
        "slip     1.25 mm in the median, 2.00 at most, 0.62° and 1.00",
        "touches  9 in the median, 10 at most",
        "limits   largest violation 0.001 rad",
        "reason   2 × it tilts, by",
        "error    1 × SolverError",
    ]
    assert kinds(table) == {"not where it stood": [1, 2], "ended by SolverError": [3]}
    alone = pa.Table.from_pylist([none | {"lifted": False, "set_down": False, "trial": 0}])
    assert "weight" not in summary(alone, 0.5) and "slip     –, –" in summary(alone, 0.5)


def test_settings_of_a_pick_are_its_worlds_and_its_grips():
    settings = PickSettings(
        mass=0.7, force=4.0, friction=0.3, actual_friction=0.8, lift=0.05, timestep=0.002, probes=9
    )
    p = pick_of(SCENE, settings)
    assert (p.force, p.friction, p.height, p.trial.probes) == (4.0, 0.3, 0.05, 9)
    world = p.trial.probe
    assert (world.support, world.mass, world.friction, world.timestep) == (
        *("pedestal", 0.7),
        *(0.8, 0.002),
    )
    for replayed in (-1, 20):
        with pytest.raises(InputError, match=r"--replay takes a trial, 0 … 19; got"):
            run("cylinder", SCENE, PickSettings(replay=replayed))


def test_a_pick_ends_once_a_return_finds_the_hand_back_where_it_was(done, monkeypatch):
    """Within a milliradian of a grasp felt before; not by one that misses, or is elsewhere."""
    p, q = pick(), np.linspace(0.1, 0.2, 11)
    contacts = [hg.Contact([0.05, 0, 0.2], [1, 0, 0])]

    def felt(at):
        return hg.Grasp(at, contacts, np.zeros((3, 11)))

    missed = hg.Missed(hg.Miss.NO_TOUCH, "finger_1")
    back, other = {"planner": "return to the best grasp"}, {"planner": "surface felt"}
    made = [
        ({"planner": None}, hg.Touch(q, felt(q))),
        (other, hg.Touch(q, felt(q + 0.5))),  # there, but by no return
        (back, hg.Touch(q, missed)),
        (back, hg.Touch(q + 2e-3, felt(q + 2e-3))),
        (back, hg.Touch(q + 0.5 + 0.9e-3, felt(q))),
        (other, hg.Touch(q, felt(q))),
    ]
    monkeypatch.setattr(hg.Trial, "touches", lambda trial, began: iter(made))
    history, rows = p._find(None)
    assert len(history) == len(rows) == 5 and rows[-1] is made[4][0]
    monkeypatch.setattr(hg.Trial, "touches", lambda trial, began: iter([*made[:2], (other, None)]))
    assert len(p._find(None)[0]) == 2
