"""Random starting postures as in the paper: the palm faces the object from a drawn side."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hqp_grasp.control.reach import reach
from hqp_grasp.errors import InputError, ReachError, positive, whole
from hqp_grasp.grasp import Grasp, Miss, as_array
from hqp_grasp.tasks import KinematicTask
from hqp_grasp.touch.probe import Probe
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

UP = np.array([0.0, 0.0, 1.0])
MAX_PLACES = 24  # of the palm, before a draw is given up
SHIFT = 0.01  # [m] the palm moves by this along the vertical, away from an edge that was met,
TURN = np.radians(15.0)  # [rad] and turns by this about its approach axis,
BACK = 2  # having withdrawn by so many advances
CLOSINGS = 16  # sampled postures of closing fingers
MOST_COMMON = 3  # reasons why draws were rejected that are told
# Draws that all fail alike, before the set-up counts as one that cannot work: were a tenth of all
# draws to touch, this would come once in 200 trials (0.9^50 = 0.5 %).
ALIKE = 50

ARM = "the arm cannot reach the drawn posture"
SPREAD = "the hand cannot spread as drawn"
EDGE = "meets an edge or an end of the object"
OWN = "the robot's own links are in one another"
REMEDIES = {  # what helps where most draws fail for this
    ARM: "move the object to where the arm can face it, or draw other elevations and offsets "
    "(Start, or `start` in robot.toml)",
    SPREAD: "draw from the spread joint's range (Start.adduction, or `start` in robot.toml)",
    OWN: "move the object to where the arms have room, or draw other elevations (Start, or `start` "
    "in robot.toml)",
    EDGE: "take a taller object, or one with upright sides",
    Miss.NO_TOUCH: "the fingers close beside the object: take a larger one, or contact points that "
    "close onto it",
    Miss.INSIDE: "the open hand is narrower than the object: take a smaller one",
    Miss.OTHER_LINK: "take a smaller or taller object, or draw other elevations (Start, or `start` "
    "in robot.toml)",
    Miss.OWN_LINK: "the fingers meet the hand before the object: take a larger one",
    Miss.TABLE: "raise the object, or let it stand on something narrower",
}


@dataclass(frozen=True, eq=False)
class FirstTouch:
    """Where a trial begins, and what it took to find it."""

    scene: Scene  # the scene asked for; a hand without an arm has been placed in it
    grasp: Grasp
    rejected: int  # draws from which the hand could not touch


@dataclass(frozen=True)
class Start:
    """Draws postures until the hand touches with every finger.

    Adduction, elevation and horizontal offset of the palm are uniform over the ranges; the
    defaults are the paper's (section 4). What it leaves open: the palm faces the object's middle
    from the robot's side (a draw beyond the object is mirrored), its opposition axis horizontal.
    It begins where the fingers barely reach, a whole number of `advance` nearer than drawn, or
    farther, and advances along the approach axis until all fingers touch. Fingers that barely reach
    a wide object close along its surface rather than into it: where some `lean` more than they
    should, their palm comes nearer still, as long as that is a touch.

    Where a fingertip then meets an edge or an end face, the palm withdraws, moves along the
    vertical and turns about the approach axis, both so that this finger comes nearer the middle,
    and advances again. A draw is rejected where the arm cannot go, another link touches, or no
    place of MAX_PLACES lets every fingertip touch the side; or where the robot's own links, if its
    description keeps them apart, are in one another. A hand without an arm is placed where
    the draw says.
    """

    adduction: tuple[float, float] = (np.radians(10.0), np.radians(90.0))  # [rad]
    elevation: tuple[float, float] = (np.radians(30.0), np.radians(50.0))  # [rad] below horizontal
    offset: tuple[float, float] = (-0.18, 0.18)  # [m] of the palm from the object, in x and in y
    facing: tuple[float, float] = (-np.radians(20.0), np.radians(20.0))
    # [rad] of several palms, seen from above, each from facing the others
    lean: float = np.radians(90.0)
    # [rad] between a finger's way as it closes and the normal, above which its palm comes nearer
    advance: float = 0.01  # [m] the palm comes nearer by, while the fingers do not reach
    max_draws: int = 500  # before the object counts as out of reach

    def __post_init__(self) -> None:
        for name in ("adduction", "elevation", "offset", "facing"):
            low, high = as_array(f"Start.{name}", getattr(self, name), (2,)).tolist()
            if low > high:
                raise InputError(f"Start.{name} must be a range (low, high); got {(low, high)}")
            object.__setattr__(self, name, (low, high))
        for name, unit in (("advance", "m"), ("lean", "rad")):
            value = positive(f"Start.{name} [{unit}]", getattr(self, name))
            object.__setattr__(self, name, value)
        object.__setattr__(self, "max_draws", whole("Start.max_draws", self.max_draws, 1))

    def draw(
        self, scene: Scene, probe_in: Callable[[Scene], Probe], rng: np.random.Generator
    ) -> FirstTouch:
        """Return the first touch that a draw finds; raise ReachError after `max_draws` without.

        It is raised, too, once the first ALIKE draws have all failed for one kind of reason.

        `probe_in` gives the probe that touches in a scene.
        """
        robot = scene.articulated
        described = {**robot.description.start, **robot.description.hand.start}
        if self == Start() and described:
            return replace(self, **described).draw(scene, probe_in, rng)
        told: Counter[str] = Counter()
        kinds: Counter[Miss | str] = Counter()
        least = robot.description.clearance
        own = SelfClearance(robot, least) if least > 0.0 else None
        for rejected in range(self.max_draws):
            if rejected == ALIKE and len(kinds) == 1:
                break
            hand = _open_hand(robot, [rng.uniform(*self.adduction) for _ in robot.groups])
            places = [self._drawn(robot, g, rng) for g in range(len(robot.groups))]
            if hand is None:
                told[SPREAD] += 1
                kinds[SPREAD] += 1
                continue
            for g, place in enumerate(places):
                reach = _reach(robot, hand[0], g) + _extent(scene)
                nearer = self.advance * np.ceil((place.distance - reach) / self.advance)
                places[g] = replace(place, distance=place.distance - nearer)
            found = self._first_touch(scene, probe_in, *hand, places)
            if not isinstance(found, _Rejected):
                inside = () if own is None else own.collisions(found[1].q)
                if not inside:
                    return FirstTouch(*found, rejected)
                found = _Rejected(OWN, f"{inside[0][0]} and {inside[0][1]} are in one another")
            told[found.told] += 1
            kinds[found.kind] += 1
        why = "; ".join(f"{count} {what}" for what, count in told.most_common(MOST_COMMON))
        remedy = REMEDIES.get(kinds.most_common(1)[0][0], "move the object, or take another")
        raise ReachError(
            f"{robot.description.name} touches the object at {scene.position} from none of "
            f"{kinds.total()} drawn postures ({why}); {remedy}",
            told,
        )

    def _drawn(self, robot: Robot, group: int, rng: np.random.Generator) -> _Place:
        """Where a palm comes from: several of them face one another."""
        elevation = rng.uniform(*self.elevation)
        if len(robot.groups) == 1:
            offset = np.array([-abs(rng.uniform(*self.offset)), rng.uniform(*self.offset)])
            distance = float(np.linalg.norm(offset)) / np.cos(elevation)
            return _Place(elevation, float(np.arctan2(-offset[1], -offset[0])), distance)
        palms = [robot.palm(robot.home, g)[0] for g in range(len(robot.groups))]
        others = np.mean(palms[:group] + palms[group + 1 :], axis=0) - palms[group]
        heading = float(np.arctan2(others[1], others[0])) + rng.uniform(*self.facing)
        return _Place(elevation, heading, self.advance * rng.random())

    def _first_touch(
        self,
        scene: Scene,
        probe_in: Callable[[Scene], Probe],
        q: np.ndarray,
        fixed: list[int],
        places: list[_Place],
    ) -> tuple[Scene, Grasp] | _Rejected:
        """Scene and grasp of the first touch that begins with palms at `places`, or why none."""
        no = _Rejected(Miss.NO_TOUCH, "no fingertip gets ahead of the palm")
        robot, places = scene.articulated, list(places)
        for _ in range(MAX_PLACES * len(places)):
            while True:
                if min(place.distance for place in places) <= 0.0:
                    return no
                reached = _placed(scene, q, fixed, places)
                if isinstance(reached, _Rejected):
                    return reached
                placed, q = reached  # the next posture is near this one
                felt = probe_in(placed).touch(q)
                if isinstance(felt, Grasp):
                    break
                no = _Rejected(felt.reason, f"{felt.reason.value} ({felt.where})")
                if felt.reason is not Miss.NO_TOUCH:
                    return no
                g = robot.group_of(felt.where)
                places[g] = replace(places[g], distance=places[g].distance - self.advance)
            if felt.other_links:
                return _Rejected(Miss.OTHER_LINK, f"{felt.other_links[0]} touches the object")
            vertical = felt.normals[:, 2]
            worst = int(np.abs(vertical).argmax())
            if abs(vertical[worst]) <= scene.object.steepest:
                return self._nearer(scene, probe_in, fixed, places, (placed, felt))
            no = _Rejected(EDGE, f"{felt.contacts[worst].name} {EDGE}")
            g = robot.group_of(felt.contacts[worst].name)
            back = places[g].distance + BACK * self.advance
            nearer = _nearer_the_middle(placed, felt, worst, g, places[g])
            places[g] = replace(nearer, distance=back)
        return no

    def _nearer(
        self,
        scene: Scene,
        probe_in: Callable[[Scene], Probe],
        fixed: list[int],
        places: Sequence[_Place],
        found: tuple[Scene, Grasp],
    ) -> tuple[Scene, Grasp]:
        """The touch `found`, or one with palms nearer, so that fingers lean less."""
        robot, law, places = scene.articulated, KinematicTask(), list(places)
        for g, group in enumerate(robot.groups):
            while law.error(found[1])[list(group.points)].max() > self.lean:
                there = replace(places[g], distance=places[g].distance - self.advance)
                reached = _placed(scene, found[1].q, fixed, [*places[:g], there, *places[g + 1 :]])
                if isinstance(reached, _Rejected):
                    break
                felt = probe_in(reached[0]).touch(reached[1])
                if not isinstance(felt, Grasp) or felt.other_links:
                    break
                if np.abs(felt.normals[:, 2]).max() > scene.object.steepest:
                    break
                places[g], found = there, (reached[0], felt)
        return found


@dataclass(frozen=True)
class _Rejected:
    """Why a draw is no start."""

    kind: Miss | str  # what may have a remedy
    told: str


@dataclass(frozen=True)
class _Place:
    """A pose of the palm, facing a point above the object's middle."""

    elevation: float  # [rad] of the approach axis, below horizontal
    heading: float  # [rad] of the approach axis, seen from above, from the x axis
    distance: float  # [m] of the palm from that point
    height: float = 0.0  # [m] of that point above the middle
    turn: float = 0.0  # [rad] about the approach axis; at 0 the opposition axis is horizontal

    @property
    def approach(self) -> np.ndarray:
        """The approach axis (3,), world."""
        level = np.cos(self.elevation)
        across, along = np.sin(self.heading), np.cos(self.heading)
        return np.array([level * along, level * across, -np.sin(self.elevation)])

    def position(self, middle: np.ndarray) -> np.ndarray:
        """p_palm (3,) [m], world, for an object whose middle is there (3,)."""
        return middle + self.height * UP - self.distance * self.approach

    def rotation(self, R_near: np.ndarray) -> np.ndarray:
        """R_world_palm (3, 3): of the two, that whose x axis is, unturned, nearer to R_near's."""
        z = self.approach
        x = np.array([-np.sin(self.heading), np.cos(self.heading), 0.0])
        x *= np.sign(R_near[:, 0] @ x) or 1.0
        y = np.array(
            [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]]
        )
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.column_stack([c * x + s * y, c * y - s * x, z])


def _nearer_the_middle(scene: Scene, felt: Grasp, finger: int, group: int, place: _Place) -> _Place:
    """A little lower or higher, and turned, so that a finger leaves the end that it met."""
    robot = scene.articulated
    lever = robot.centers(felt.q)[finger] - robot.palm(felt.q, group)[0]
    z = place.approach
    rises = np.sign(z[0] * lever[1] - z[1] * lever[0])  # when the palm turns about z
    end = np.sign(felt.normals[finger, 2])  # 1: the upper one
    return replace(place, height=place.height - end * SHIFT, turn=place.turn - end * rises * TURN)


def _open_hand(robot: Robot, adductions: Sequence[float]) -> tuple[np.ndarray, list[int]] | None:
    """The home posture with fingers open and spread as drawn, and the joints of the hands.

    None where a hand cannot spread so far.
    """
    q = np.clip(robot.home, robot.q_lower, robot.q_upper)
    fixed = [j for joints in robot.flexion for j in joints]
    q = robot.opened(q)
    for group, adduction in zip(robot.groups, adductions, strict=True):
        spread = group.adduction
        if spread is None:
            continue
        if not robot.q_lower[spread] <= adduction <= robot.q_upper[spread]:
            return None
        q[spread] = adduction
        fixed.append(spread)
    return q, fixed


def _reach(robot: Robot, q: np.ndarray, group: int) -> float:
    """How far before its palm every fingertip can get while it closes from q (n,) [m]."""
    (p_palm, R_palm), own = robot.palm(q, group), list(robot.groups[group].points)
    farthest = np.full(len(own), -np.inf)
    for share in np.linspace(0.0, 1.0, CLOSINGS):
        closed = robot.opened(q, share)
        ahead = ((robot.centers(closed) - p_palm) @ R_palm[:, 2] + robot.tip_radius)[own]
        farthest = np.maximum(farthest, ahead)
    return float(farthest.min())


def _extent(scene: Scene) -> float:
    """Radius about its middle [m] within which the object lies."""
    model = scene.model
    geoms = model.geom_bodyid == model.body(OBJECT).id
    return float((np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms]).max())


def _placed(
    scene: Scene, q: np.ndarray, fixed: list[int], places: Sequence[_Place]
) -> tuple[Scene, np.ndarray] | _Rejected:
    """Joints, from q on, that bring the palms to their places, or whose arm no step is shown to."""
    robot = scene.articulated
    for g, place in enumerate(places):
        p_palm = place.position(np.array(scene.position))
        R_palm = place.rotation(robot.palm(robot.home, g)[1])
        if not robot.arm:
            p_now, R_now = robot.palm(q)
            turn = R_palm @ R_now.T
            return scene.rebased(p_palm - turn @ p_now, turn), q
        others = [j for j in range(robot.n) if j not in robot.groups[g].arm]
        keep = fixed if len(places) == 1 else others
        found = reach(robot, q, p_palm, R_palm, keep, group=g)
        if found is None:
            several = f" ({robot.groups[g].name})" if len(places) > 1 else ""
            return _Rejected(ARM, ARM + several)
        q = found
    return scene, q
