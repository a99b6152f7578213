"""What a robot's description amounts to, in words and as a picture: hqp-grasp robot."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import mujoco
import numpy as np

from hqp_grasp.errors import one_of
from hqp_grasp.files import whole_file
from hqp_grasp.touch.geometric import TILT
from hqp_grasp.world.clearance import SelfClearance
from hqp_grasp.world.description import CARRIAGE, RobotDescription
from hqp_grasp.world.robot import CAPSULE, CENTRED, SPHERE, Robot, compiled, described
from hqp_grasp.world.second_opinion import second_opinion

CLOSINGS = np.linspace(0.0, 1.0, 21)  # shares by which fingers are closed
AGREES = 1e-6  # [m, rad] two readings that differ by less are the same


def check(path: str | Path, hand: str | None = None, picture: str | Path | None = None) -> str:
    """Describe a robot as it was understood; raise ModelError for one that cannot grasp.

    `picture` is the file of a drawing with its contact points and the ways they close.
    """
    about = described(path, hand)
    robot = Robot(about, compiled(about))
    clearance = SelfClearance(robot, max(about.clearance, 1e-4))
    out = [name for name, stays in about.equalities.items() if not stays]
    text = "\n".join(
        [
            f"{about.name}: {robot.n} independent joints, {robot.model.njnt} in all; hands: "
            f"{', '.join(h.name for h in about.hands)} ({about.hand.name} grasps)",
            *_files(about),
            "",
            *_joints(robot),
            *([f"left out, of the files' equalities: {', '.join(out)}"] if out else []),
            *_followers(robot),
            *_tendons(robot),
            "",
            *_contact_points(robot),
            "",
            *_palms(robot),
            "",
            *_self_collisions(robot, clearance),
        ]
    )
    if picture is not None:
        draw(robot, picture)
        text += f"\n\npicture  {picture}"
    return text


def _files(about: RobotDescription) -> list[str]:
    lines = []
    for part in about.files:
        both = second_opinion(part)
        if both.reason:
            told = both.reason
        else:
            same = max(both.position, both.jacobian) < AGREES
            told = (
                f"MuJoCo and Pinocchio {'agree' if same else 'DIFFER'}: {both.position:.0e} m, "
                f"{both.jacobian:.0e} m/rad, {both.weight:.0e} N·m of its weight"
            )
        lines.append(f"  {part.file.name}: {told}")
    return lines


def _joints(robot: Robot) -> list[str]:
    names = _names(robot)
    width = max(map(len, robot.joints))
    lines = [f"{'joint':{width}}  {'range':>16}  {'home':>7}  {'speed':>6}  drives"]
    for j, joint in enumerate(robot.joints):
        driven = [
            f"{names[i]} = {robot.coupling[i, j]:.3g}·" + (f" + {c:.3g}" if c else "")
            for i in np.flatnonzero(robot.coupling[:, j])
            if names[i] != joint
            for c in [robot.offset[i]]
        ]
        ends = f"{robot.q_lower[j]:.2f} … {robot.q_upper[j]:.2f}"
        role = ", ".join(driven) or ("moves no contact point: held" if robot.idle[j] else "")
        lines.append(
            f"{joint:{width}}  {ends:>16}  {robot.home[j]:7.2f}  {robot.velocity[j]:6.2f}  {role}"
        )
    return lines


def _followers(robot: Robot) -> list[str]:
    """Coupled joints that home would have elsewhere than they follow to."""
    full = dict(zip(_names(robot), robot.coupling @ robot.home + robot.offset, strict=True))
    return [
        f"home has {joint} at {angle:.3g}; it is coupled, and follows to {full[joint]:.3g}"
        for joint, angle in robot.description.home.items()
        if abs(full[joint] - angle) > AGREES
    ]


def _names(robot: Robot) -> list[str]:
    return [robot.model.joint(j).name for j in range(robot.model.njnt)]


def _tendons(robot: Robot) -> list[str]:
    """Tendons that bind joints by an actuator or limits, which is not read."""
    model = robot.model
    lines, together = [], []
    for t in range(model.ntendon):
        driven = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)) & (
            model.actuator_trnid[:, 0] == t
        )
        acts = ["an actuator drives it"] if driven.any() else []
        if model.tendon_limited[t]:
            low, high = model.tendon_range[t]
            acts.append(f"its length is limited to {low:.3g} … {high:.3g}")
        if not acts:
            continue
        wraps = slice(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
        fixed = (model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)).all()
        joints = model.wrap_objid[wraps].tolist() if fixed else []
        free = robot.coupling[joints].any(axis=0).sum()
        if fixed and free < 2 and not model.tendon_limited[t]:
            continue  # couplings say by now how its joints move together
        names = [model.joint(j).name for j in joints]
        over = ", ".join(names) or "sites, along a path in space"
        lines.append(f"  {model.tendon(t).name or t} over {over}: {' and '.join(acts)}")
        if free > 1:
            together += [
                f'{{ joint = "{name}", to = "{names[0]}", ratio = 1.0 }}' for name in names[1:]
            ]
    if not lines:
        return []
    told = [
        "tendons that are not read: joints are taken as if nothing of this bound them. Where they",
        "  move together couplings says so, where they are limited ranges does",
        *lines,
    ]
    if together:
        told += [
            "  Were all their joints to turn alike, this would be among the couplings:",
            f"couplings = [{', '.join(together)}]",
        ]
        if any(robot.description.equalities.values()):
            told += ["drop_couplings = []  # keeps the files' own equalities"]
    return told


def _contact_points(robot: Robot) -> list[str]:
    about, model = robot.description, robot.model
    lines = ["contact points"]
    J = robot.jacobian(robot.home).reshape(-1, 3, robot.n)
    x, ways = robot.centers(robot.home), robot.closing_at(robot.home)
    arms = {i: group.name for group in robot.groups for i in group.points}
    for i, point in enumerate(about.contact_points):
        kinds = [_shape(model, g) for g in robot.geoms[i]]
        closing = ", ".join(
            f"{robot.joints[j]} {robot.closing[i, j]:+.2g}" for j in robot.flexion[i]
        )
        if point.by_arm:
            closing = f"the arm of {arms[i]}, straight along its palm's approach axis"
        found = "" if point.closing is not None else " (found by itself; flexion = {…} says other)"
        lines.append(f"  {point.name} on {point.link or _link(robot, i)}: {', '.join(kinds)}")
        lines.append(f"    closes with {closing or 'nothing'}{found}")
        others = np.delete(x, i, axis=0)
        if len(others) and ways[i].any():
            towards = others.mean(axis=0) - x[i]
            if np.linalg.norm(towards) < CENTRED:
                lines.append("    at home it is amid the others, and moves towards none")
                continue
            speed = float(J[i] @ ways[i] @ towards / np.linalg.norm(towards))
            way = "towards" if speed > 0.0 else "AWAY FROM"
            per = "m" if point.by_arm else "rad"
            lines.append(f"    at home it moves {way} the others at {1e3 * speed:+.0f} mm/{per}")
    if len(x) > 1 and robot.closing.any():
        radii = [_spread(robot.centers(robot.opened(robot.home, s))) for s in CLOSINGS]
        lines.append(
            f"  as they close, tips are {1e3 * radii[0]:.0f} … {1e3 * min(radii):.0f} mm from "
            "their middle: an object must fit between"
        )
    return lines


def _spread(x: np.ndarray) -> float:
    """Mean distance of points (k, 3) from their middle [m]."""
    return float(np.linalg.norm(x - x.mean(axis=0), axis=1).mean())


def _shape(model: mujoco.MjModel, geom: int) -> str:
    """What a geom is, and what is to be expected of a tip of this shape."""
    kind = int(model.geom_type[geom])
    radius = f"{1e3 * model.geom_size[geom, 0]:.3g} mm"
    if kind == SPHERE:
        return f"ball of {radius} (touches at a point)"
    half = float(model.geom_size[geom, 1] if kind == CAPSULE else model.geom_aabb[geom, 3:].max())
    runs = f"{1e3 * np.radians(half / TILT):.2g} mm for each degree that it turns"
    if kind == CAPSULE:
        return (
            f"capsule of {radius} (touches as a ball at its ends; laid along the object it counts "
            f"by the middle of its touch, which runs along it by up to {runs})"
        )
    name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
    return f"{name} (its touching patch counts by its middle, which runs along it by up to {runs})"


def _link(robot: Robot, i: int) -> str:
    return robot.model.body(int(robot.model.geom_bodyid[robot.geoms[i][0]])).name


def _palms(robot: Robot) -> list[str]:
    about, lines = robot.description, []
    for group, said in zip(robot.groups, about.grasping, strict=True):
        if len(robot.groups) > 1:
            lines.append(f"group    {group.name}")
        arm = [robot.joints[j] for j in group.arm]
        carried = "six virtual joints" if arm == list(CARRIAGE) else ", ".join(arm)
        lines.append(f"arm      {carried or 'none: the hand is placed where a start says'}")
        if said.palm is None:
            lines.append("palm     none given; found from how the fingers close. To fix it, add")
        p, R = group.p_palm, group.R_palm
        lines.append(
            (
                f"palm = {{ body = {robot.model.body(group.palm_body).name!r}, pos = {_row(p)}, "
                f"approach = {_row(R[:, 2])}, opposition = {_row(R[:, 0])} }}"
            ).replace("'", '"')
        )
    if about.workspace is None:
        lines += ["workspace  none given; amid the tips at home. To fix it, add"]
    lines.append(f"workspace = {_row(np.array(robot.workspace))}")
    return lines


def _row(v: np.ndarray) -> str:
    return "[" + ", ".join(f"{x + 0.0:.3f}" for x in v) + "]"


def _self_collisions(robot: Robot, clearance: SelfClearance) -> list[str]:
    lines = [
        f"clearance  {1e3 * robot.description.clearance:.3g} mm, watched over "
        f"{len(clearance.pairs)} pairs of geoms"
    ]
    if clearance.at_home:
        pairs = ", ".join(f"{a} – {b}" for a, b in clearance.at_home[:8])
        more = f", and {len(clearance.at_home) - 8} more" if len(clearance.at_home) > 8 else ""
        lines.append(f"  touch at home, taken to be so by design: {pairs}{more}")
    return lines


def draw(robot: Robot, path: str | Path) -> None:
    """Draw links as lines, contact points and the ways they close, at home."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    model = robot.model
    data = mujoco.MjData(model)
    robot.place(data, robot.home)
    figure = plt.figure(figsize=(7, 7))
    axes = figure.add_subplot(projection="3d")
    for body in range(1, model.nbody):
        ends = data.xpos[[body, model.body_parentid[body]]]
        if model.body_parentid[body] > 0:
            axes.plot(*ends.T, color="0.5", linewidth=2)
    x = robot.centers(robot.home)
    J = robot.jacobian(robot.home).reshape(-1, 3, robot.n)
    ways = np.einsum("kan,kn->ka", J, robot.closing_at(robot.home))
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    axes.scatter(*x.T, color="tab:orange")
    axes.quiver(*x.T, *ways.T, length=0.04, color="tab:orange", label="closing")
    for g in range(len(robot.groups)):
        p, R = robot.palm(robot.home, g)
        again = "_" if g else ""  # a label that the legend leaves out
        axes.quiver(*p, *R[:, 2], length=0.08, color="tab:blue", label=again + "approach")
        axes.quiver(*p, *R[:, 0], length=0.05, color="tab:green", label=again + "opposition")
    for point, place in zip(robot.description.contact_points, x, strict=True):
        axes.text(*place, point.name)
    axes.set_aspect("equal")
    axes.legend()
    valid = sorted(figure.canvas.get_supported_filetypes())
    kind = one_of("kind of picture", Path(path).suffix.removeprefix("."), valid)
    with whole_file(path) as part:
        figure.savefig(part, dpi=120, format=kind)
    plt.close(figure)
