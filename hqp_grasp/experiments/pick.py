"""A pick, from nothing to an object lifted and set down again: one seed in, one row out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from hqp_grasp.control.forces import Grip
from hqp_grasp.control.hold import Hold
from hqp_grasp.errors import InputError, instance, positive
from hqp_grasp.experiments.lifting import Lift, Moment, lift
from hqp_grasp.experiments.record import kind_and_message
from hqp_grasp.experiments.table import table_of
from hqp_grasp.experiments.trial import Began, Trial, entropy_of
from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.touch.physical import NOTICED, PhysicalProbe
from hqp_grasp.touch.simulated import SimulatedHand, Truth
from hqp_grasp.world.physics import simulated_model
from hqp_grasp.world.scene import Scene

HELD = ("loosen", "lift", "hold", "shake")  # phases in which the object should not slip
AFTER = 0.5  # [s] after which a released object stands, or does not
BACK = 1e-3  # [rad] of a posture where it was before, within which the hand is there again
SHARE = 0.75  # of the driver's grip limit that a grip may ask of one contact: the rest is for bumps
RISEN = 0.9  # share of the palm's way that a lifted object has risen by, at least
STANDS = 0.01  # [m] from where it stood, within which an object was set down there
UPRIGHT = np.radians(15.0)

COLUMNS = {
    "lifted": "bool: the object was at the height asked for, and held there",
    "set_down": "bool: it stands within 1 cm of where it stood, upright, let go",
    "felt_weight": "kg: of the object, as the fingertips felt it at the top",
    "height": "m: the object rose by",
    "slip_mm": "mm: the object moved in the palm's frame while it was held",
    "slip_deg": "deg: it turned there",
    "sum_normal": "N: of the contacts' normal forces at the top, as felt",
    "touches": "count: touches until the grasp was found",
    "duration": "s: simulated, in all",
    "limit_violation": "rad: how far the worst joint was outside its range",
    "reason": "text: what went wrong, or why the object was set down early; null where nothing did",
    "error": "text: what ended the trial, kind and message; null where nothing did",
}
# One look while the hand holds; the fields of the column `looks`.
LOOK = {
    "time": "s: on the hand's clock",
    "phase": "text: tighten, loosen, lift, hold, shake or lower",
    "strength": "N: mean normal force that is asked for",
    "used": "–: friction that the contact nearest to slipping uses",
    "load": "N: net force of the contacts on the object, upwards",
    "normal": "N: normal force of each contact; empty where nothing was felt",
    "q": "rad: joint angles",
    "contacts": "m, –, N: position, normal, force on the object of each contact, nine numbers each",
    "object": "m, quaternion: where the object is, world",
}


@dataclass(frozen=True, eq=False, repr=False)
class Picked:
    """What one pick brought."""

    seed: tuple[int, ...]
    row: Mapping[str, object]  # the COLUMNS
    looks: tuple[Mapping[str, object], ...] = ()  # the LOOKs
    touches: tuple[Touch, ...] = ()  # that found the grasp,
    told: tuple[Mapping[str, object], ...] = ()  # and their rows, as in a record

    def __repr__(self) -> str:
        if self.row["error"]:
            return f"<Pick of seed {self.seed}: ended by {self.row['error']}>"
        done = " and ".join(
            words if self.row[name] else f"not {words}"
            for name, words in (("lifted", "lifted"), ("set_down", "set down"))
        )
        why = f": {self.row['reason']}" if self.row["reason"] else ""
        return f"<Pick of seed {self.seed}: {done}{why}>"

    def to_table(self) -> pa.Table:
        """One row, with the looks as a column of lists."""
        table = table_of([self.row], COLUMNS)
        about = pa.field("looks", pa.list_(_LOOKS), metadata={"meaning": "while it was held"})
        return table.append_column(about, pa.array([list(self.looks)], pa.list_(_LOOKS)))


_NUMBERS = pa.list_(pa.float64())
_LOOKS = pa.struct(
    [
        pa.field(
            name,
            pa.string()
            if name == "phase"
            else pa.float64()
            if name in ("time", "strength", "used", "load")
            else _NUMBERS,
            metadata={"meaning": meaning},
        )
        for name, meaning in LOOK.items()
    ]
)


@dataclass(frozen=True)
class Pick:
    """Find an object by touch, hold it, lift it, shake it, set it down: a function of a seed.

    `trial` finds the grasp with a simulated hand and a free object; it ends as soon as the hand has
    settled. `friction` is what the grip believes in, of the trial's `Physics.friction` it knows
    nothing, nor of the mass.
    """

    file: ClassVar[str] = "picks.parquet"  # that a study of it ends in
    trial: Trial
    force: float = 5.0  # [N] mean normal force of a contact, at least
    friction: float = 0.5
    height: float = 0.1  # [m]

    def __post_init__(self) -> None:
        instance("Pick.trial", self.trial, Trial)
        for name in ("force", "friction", "height"):
            object.__setattr__(self, name, positive(f"Pick.{name}", getattr(self, name)))
        physics = self.trial.physics
        if physics is None or physics.support == "fixed":
            raise InputError(
                "Pick.trial must touch an object that can be lifted: "
                'Trial(…, probe=Physics(support="pedestal"))'
            )
        if not self.trial.scene.articulated.arm:
            name = self.trial.scene.articulated.description.name
            raise InputError(f"{name} has no arm to lift with; put it on one, or judge its grasps")
        self._hold(self.trial.scene)  # refuses a robot that cannot press, or not so hard,
        simulated_model(self.trial.scene, physics, self.trial.links)  # or that is not driven

    @property
    def scene(self) -> Scene:
        """Where it takes place."""
        return self.trial.scene

    def run(self, seed: int | Sequence[int]) -> Picked:
        """Pick once. Raises what goes wrong on the way, other than a failed pick."""
        entropy = entropy_of(seed)
        began = self.trial.begin(entropy)
        hand, probe = began.hand, began.touching
        assert hand is not None and isinstance(probe, PhysicalProbe)
        history, told = self._find(began)
        row: dict[str, object] = dict.fromkeys(COLUMNS)
        row |= {"lifted": False, "set_down": False, "touches": len(history)}
        last = history[-1].felt
        if not isinstance(last, Grasp):
            row["reason"] = f"no grasp to lift: {last.reason.value} ({last.where})"
            return Picked(entropy, row, (), history, told)
        log = _Log(hand)
        hold = self._hold(began.first.scene, hand.limits.grip)
        done = lift(probe, hold, last, self.height, log.look)
        hand.wait(AFTER)
        row |= log.row(done, self.height)
        return Picked(entropy, row, tuple(log.looks), history, told)

    def attempt(self, seed: Sequence[int]) -> Picked:
        """`run`, but what it raises becomes the row's error."""
        # One failing pick must not cost the others of a study.
        try:
            return self.run(seed)
        except Exception as error:
            return self.nothing(seed, kind_and_message(error))

    def nothing(self, seed: Sequence[int], error: str) -> Picked:
        """The row of a pick of which nothing is known but what ended it."""
        row = dict.fromkeys(COLUMNS) | {"lifted": False, "set_down": False, "error": error}
        return Picked(entropy_of(seed), row)

    def _hold(self, scene: Scene, grip: float = np.inf) -> Hold:
        most = min(Grip.most, SHARE * grip)
        return Hold(Grip(scene.articulated, self.force, self.friction, most))

    def _find(self, began: Began) -> tuple[tuple[Touch, ...], tuple[Mapping[str, object], ...]]:
        """Touch until the hand has settled, gives up, or has made all its touches; their rows."""
        history: list[Touch] = []
        rows: list[Mapping[str, object]] = []
        for row, touch in self.trial.touches(began):
            if touch is None:
                break
            history.append(touch)
            rows.append(row)
            settled = str(row.get("planner") or "").startswith("return")
            if settled and isinstance(touch.felt, Grasp):
                before = (t.felt for t in history[:-1] if isinstance(t.felt, Grasp))
                if any(np.abs(touch.q_target - grasp.q).max() < BACK for grasp in before):
                    break
        return tuple(history), tuple(rows)


class _Log:
    """What a simulation knows of a lift, look by look."""

    def __init__(self, hand: SimulatedHand) -> None:
        self._hand = hand
        self.looks: list[dict[str, object]] = []
        self._truths = [("", hand.truth())]

    def look(self, moment: Moment) -> None:
        """Take down one look."""
        truth, press = self._hand.truth(), moment.press
        self._truths.append((moment.phase, truth))
        contacts: list[float] = []
        normal: list[float] = []
        if isinstance(moment.felt, Grasp):
            for contact in moment.felt.contacts:
                assert contact.wrench is not None
                force = -contact.wrench[:3]
                contacts += [*contact.position, *contact.normal, *force]
                normal.append(-float(force @ contact.normal))
        q = moment.felt.q.tolist() if isinstance(moment.felt, Grasp) else []
        self.looks.append(
            {
                "time": moment.time,
                "phase": moment.phase,
                "strength": press.strength,
                "used": press.used,
                "load": press.load,
                "normal": normal,
                "q": q,
                "contacts": [float(number) for number in contacts],
                "object": truth.place.tolist(),
            }
        )

    def row(self, done: Lift, height: float) -> dict[str, object]:
        """What became of it, by what is and by what was felt."""
        stood, ends = self._truths[0][1], self._hand.truth()
        held = [t for phase, t in self._truths if phase in HELD]
        rose = max((float(t.place[2] - stood.place[2]) for t in held), default=0.0)
        slip, turned = _apart(held)
        normal = [sum(look["normal"]) for look in self.looks if look["phase"] == "hold"]  # type: ignore[call-overload]
        aside = float(np.linalg.norm(ends.place[:3] - stood.place[:3]))
        free = np.linalg.norm(ends.forces, axis=1).max() < NOTICED and not ends.other_links
        standing = free and aside < STANDS and _turned(stood.place, ends.place) < UPRIGHT
        return {
            "lifted": bool(done.lifted and rose > RISEN * height),
            "set_down": bool(standing),
            "felt_weight": done.weight if np.isfinite(done.weight) else None,
            "height": rose,
            "slip_mm": 1e3 * slip,
            "slip_deg": float(np.degrees(turned)),
            "sum_normal": float(np.mean(normal)) if normal else None,
            "duration": self.looks[-1]["time"] if self.looks else None,
            "limit_violation": max(0.0, self._hand.worst["range [rad]"]),
            "reason": done.reason or None,
        }


def _apart(held: Sequence[Truth]) -> tuple[float, float]:
    """How far the object moved [m] and turned [rad] in the palm's frame, since the first truth."""
    moved = turned = 0.0
    for truth in held[1:]:
        moved = max(moved, float(np.linalg.norm(truth.in_palm[:3] - held[0].in_palm[:3])))
        turned = max(turned, _turned(held[0].in_palm, truth.in_palm))
    return moved, turned


def _turned(one: np.ndarray, other: np.ndarray) -> float:
    """Angle [rad] between the orientations of two poses (7,)."""
    return float(2.0 * np.arccos(min(1.0, abs(one[3:] @ other[3:]))))
