"""A first description of a robot of which there is only the model: what is found, each with why."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np

from hqp_grasp.errors import HqpGraspError, ModelError
from hqp_grasp.files import whole_file
from hqp_grasp.world.compiling import compiled_spec
from hqp_grasp.world.description import ModelFile, RobotDescription
from hqp_grasp.world.robot import Robot, compiled, with_palm

ARM = 4  # joints; what carries a palm by fewer cannot bring it to an object, and turn it there
FINGERS = 3  # that grasp: what the laws have been tried with most
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FREE = int(mujoco.mjtJoint.mjJNT_FREE)


def write_draft(path: Path) -> Path:
    """Write a first description beside a model file, NAME.toml; return where it is.

    Raises ModelError where one is there already, and for a model in which nothing can touch.
    """
    out = path.with_suffix(".toml")
    if out.exists():
        raise ModelError(
            f"{out} is there already, and is left as it is: hqp-grasp robot {out} checks it; move "
            "it away for a new first description"
        )
    text = draft(path)
    with whole_file(out) as part:
        part.write_text(text, encoding="utf-8")
    return out


def draft(path: Path) -> str:
    """The text of a first description of the robot in a model file."""
    found = _Found.of(path)
    bare = found.text()
    try:
        about = with_palm(RobotDescription.read(bare, path.with_suffix(".toml")))
        robot = Robot(about, compiled(about))
    except HqpGraspError as error:
        return bare + _comment(f"Not accepted as it stands. {error}")
    return found.text(robot)


@dataclass(frozen=True)
class _Found:
    """What the model's tree of bodies says."""

    path: Path
    degrees: bool | None  # said where the file does not
    root: str  # of several root bodies the robot's, "" where there is one
    palm: str  # the body that the fingers hang from, "world" where they hang from nothing
    arm: tuple[str, ...]  # joints that carry it
    free: tuple[str, ...]  # free bases
    fixed: bool  # nothing moves the root body, so a carriage can
    tips: tuple[str, ...]  # links that touch
    others: tuple[str, ...]  # that could as well

    @classmethod
    def of(cls, path: Path) -> _Found:
        file, degrees = ModelFile(path), None
        try:
            spec = file.spec()
        except ModelError:
            if file.is_urdf:
                raise
            degrees = False  # the file lists radians and does not say so; else this raises too
            spec = replace(file, degrees=degrees).spec()
        model = compiled_spec(spec, f"{path.name} does not compile")
        tips = _tips(model)
        if not tips:
            raise ModelError(
                f"{path.name}: no link that a joint moves has a geom that collides, so nothing in "
                "it can touch; write a description by hand, its contact points with a ball = "
                "{ pos = [x, y, z], radius = r }"
            )
        palm, of_hand = _hand(model, tips)
        chosen = _widest(model, of_hand)
        above = _above(model, palm)
        base = above[-1] if above else 0
        roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0]
        alone = len(roots) == 1 and not (model.geom_bodyid == 0).any()
        name = lambda body: model.body(body).name  # noqa: E731
        free = [j for j in range(model.njnt) if model.jnt_type[j] == FREE]
        return cls(
            path,
            degrees,
            "" if alone or not base else name(base),
            name(palm),
            tuple(model.joint(j).name for body in reversed(above) for j in _joints(model, body)),
            tuple(model.joint(j).name for j in free),
            bool(base) and not _joints(model, base),
            tuple(name(body) for body in chosen),
            tuple(name(body) for body in tips if body not in chosen),
        )

    @property
    def carriage(self) -> bool:
        """Whether six virtual joints are to carry the palm."""
        return self.fixed and len(self.arm) < ARM

    def text(self, robot: Robot | None = None) -> str:
        """As TOML; with what a robot made of it adds."""
        own = self.path.with_suffix(".toml").name
        told = _comment(
            f"First description of {self.path.name}, as far as the file says. Correct it, then let "
            f"it be checked: hqp-grasp robot {own} --picture {self.path.stem}.png"
        )
        lines = [told.rstrip("\n"), f"model = {_quoted(self.path.name)}"]
        if self.degrees is not None or self.root:
            lines = [lines[0]]
        if self.carriage:
            why = (
                f"only {len(self.arm)} of the file's joints carry"
                if self.arm
                else "nothing carries"
            )
            lines.append(f"carriage = true  # {why} {self.palm!r}: six virtual joints do")
        locked = (*self.free, *(self.arm if self.carriage else ()))
        if locked:
            why = (
                "a free base is fixed"
                if self.free
                else "the carriage moves the palm in their place"
            )
            lines.append(f"lock = [{', '.join(map(_quoted, locked))}]  # {why}")
        lines += _of_hand(robot) if robot is not None else []
        if self.degrees is not None or self.root:
            lines += ["", "[[model]]", f"file = {_quoted(self.path.name)}"]
            if self.root:
                lines.append(f"root = {_quoted(self.root)}  # the file has more beside it")
            if self.degrees is not None:
                lines.append(
                    "degrees = false  # the file does not say; its ranges look like radians"
                )
        lines += _home(robot) if robot is not None else []
        for tip in self.tips:
            lines += ["", "[[contact_points]]"]
            why = "the last link of its chain that collides with anything"
            if self.others:
                why += f"; one of {len(self.tips) + len(self.others)}: the widest apart of a hand"
            lines.append(f"link = {_quoted(tip)}  # {why}")
            lines += _flexion(robot, tip) if robot is not None else []
        if self.others:
            lines += ["", "# Left out: " + ", ".join(self.others)]
        if len(self.tips) == 1:
            lines += ["", "# One contact point grasps nothing: name what it presses against."]
        return "\n".join(lines) + "\n"


def _tips(model: mujoco.MjModel) -> list[int]:
    """Bodies that joints move, with geoms that collide, below which no other such body hangs."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    solid = set(model.body_weldid[model.geom_bodyid[collides]].tolist())
    moved = [
        b
        for b in range(1, model.nbody)
        if b in solid and any(_joints(model, a) for a in _above(model, b))
    ]
    inner = {a for b in moved for a in _above(model, int(model.body_parentid[b]))}
    return [b for b in moved if b not in inner]


def _hand(model: mujoco.MjModel, tips: Sequence[int]) -> tuple[int, list[int]]:
    """The body from which most tips hang by branches of their own, and these tips.

    Of bodies with branches only the outermost count: those of a hand, not the shoulders' of two.
    """
    below: dict[int, list[int]] = {}
    for tip in tips:
        for body in (*_above(model, int(model.body_parentid[tip])), 0):
            below.setdefault(body, []).append(tip)
    branches = {body: own for body, own in below.items() if len(own) > 1}
    if not branches:
        return int(model.body_parentid[tips[0]]), list(tips)
    outermost = {
        body: own
        for body, own in branches.items()
        if not any(body in (*_above(model, b)[1:], 0) and b != body for b in branches)
    }
    palm = max(outermost, key=lambda body: len(outermost[body]))
    return palm, outermost[palm]


def _widest(model: mujoco.MjModel, tips: Sequence[int]) -> list[int]:
    """The three tips that span the largest triangle where the file puts them; all of fewer."""
    if len(tips) <= FINGERS:
        return list(tips)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)

    def area(three: Iterable[int]) -> float:
        a, b, c = data.xipos[list(three)]
        return float(np.linalg.norm(np.cross(b - a, c - a)))

    return list(max(combinations(tips, FINGERS), key=area))


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    """The body and those that carry it, up to its root."""
    chain = []
    while body:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain


def _joints(model: mujoco.MjModel, body: int) -> list[int]:
    """Hinges and slides of a body."""
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return [j for j in range(first, first + count) if model.jnt_type[j] in (HINGE, SLIDE)]


def _of_hand(robot: Robot) -> list[str]:
    """Palm and place of the object, as found."""
    group = robot.groups[0]
    p, R, body = group.p_palm, group.R_palm, robot.model.body(group.palm_body).name
    return [
        f"workspace = {_row(robot.workspace)}  # [m] amid the tips at home: where an object stands",
        f"palm = {{ body = {_quoted(body)}, pos = {_row(p)}, approach = {_row(R[:, 2])}, "
        f"opposition = {_row(R[:, 0])} }}  # from how the fingers close: the axis out of the palm, "
        "and the one along which they oppose",
    ]


def _home(robot: Robot) -> list[str]:
    """A home to begin with."""
    if robot.description.files[0].keyframes():
        return [
            "",
            '# home: the file\'s keyframe "home" if it has one, else zero, within the ranges',
        ]
    own = [j for j in range(robot.n) if robot.closing[:, j].any()]
    lines = [
        "",
        "[home]  # [rad, m] where the file puts them; best is a hand open around the object",
    ]
    return lines + [f"{_key(robot.joints[j])} = {robot.home[j]:.4g}" for j in own]


def _flexion(robot: Robot, tip: str) -> list[str]:
    """How a contact point closes, as found."""
    i = [point.name for point in robot.description.contact_points].index(tip)
    weights = ", ".join(
        f"{_key(robot.joints[j])} = {robot.closing[i, j]:.3g}"
        for j in np.flatnonzero(robot.closing[i])
    )
    why = "joints parallel to its last one, towards the other contact points"
    return [f"flexion = {{ {weights} }}  # {why}"] if weights else []


def _row(v: Sequence[float] | np.ndarray) -> str:
    return "[" + ", ".join(f"{x + 0.0:.4f}" for x in v) + "]"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _key(name: str) -> str:
    """A name as a key of TOML."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _comment(text: str) -> str:
    words, lines = " ".join(text.split()).split(" "), ["#"]
    for word in words:
        if len(lines[-1]) + 1 + len(word) > 100:
            lines.append("#")
        lines[-1] += " " + word
    return "\n".join(lines) + "\n"
