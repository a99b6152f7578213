"""A trial to look at: robot, object and what was felt, in one file that any browser plays."""

from __future__ import annotations

import contextlib
import html
import importlib
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hqp_grasp.errors import InputError, ResultsError, missing
from hqp_grasp.experiments.plots import ANGLE, FLOOR, FORCE, MOMENT
from hqp_grasp.experiments.record import (
    CONTACT_COLUMNS,
    CONVERGED_FORCE,
    CONVERGED_MOMENT,
    Record,
    holds,
)
from hqp_grasp.files import whole_file
from hqp_grasp.grasp import Grasp, Touch
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

Colour = tuple[int, int, int]
ERRORS = ("eps_f", "eps_m", "eps_k", "friction_demand")  # in N², (N·m)², rad, 1
PLACED = 1e-5  # [m] tips fit their contacts to this, or the hand is elsewhere
SECONDS_A_PROBE = 1.0  # the time bar counts seconds, so it counts probes
ARROW = 0.04  # [m] a unit vector, a force of 1 N
CARRY_ARROW = 0.006  # [m/N] while the object is held
NORMAL_COLOUR, FORCE_COLOUR, NET_COLOUR = (204, 61, 163), (0, 60, 230), (200, 20, 20)
FELT_COLOUR = (30, 30, 30)
GHOST_COLOUR = (70, 130, 230)
GREY = (150, 150, 150)
ARROWS = {  # [m]
    "normals": {"shaft_radius": 0.0012, "head_radius": 0.0035, "head_length": 0.009},
    "forces": {"shaft_radius": 0.0022, "head_radius": 0.005, "head_length": 0.011},
    "net_force": {"shaft_radius": 0.0022, "head_radius": 0.005, "head_length": 0.011},
}
GEOM_GROUPS = 3  # MuJoCo's viewers show groups 0, 1 and 2
CREASE = np.radians(35.0)  # edges sharper than this stay sharp
VIEW_FROM = np.array([0.45, -0.83, 0.33])  # direction from the object to the camera


@dataclass(frozen=True, eq=False)
class Frame:
    """One probe as it is drawn. Without a touch, posture and contacts are those of the last one."""

    q: np.ndarray  # (n,) independent joints [rad]
    positions: np.ndarray  # (k, 3) contacts [m], world
    normals: np.ndarray  # (k, 3) outward unit normals, world
    errors: Mapping[str, float]  # ERRORS of this probe, NaN where it did not touch
    outcome: str
    touched: bool
    held: Held | None = None  # of a look at what the hand holds, which is no probe


@dataclass(frozen=True, eq=False)
class Held:
    """What the hand holds, as it is drawn."""

    forces: np.ndarray  # (k, 3) [N] of the contacts on the object, world
    place: np.ndarray  # (7,) the object's [m] and quaternion, world
    duration: float  # [s] until the next look
    lines: tuple[str, ...]  # about it


def frames_of_pick(
    rows: Sequence[Mapping[str, Any]], touches: Sequence[Touch], looks: Sequence[Mapping[str, Any]]
) -> list[Frame]:
    """The probes of a pick, then the looks at what the hand holds: the fields of `pick.LOOK`."""
    felt = [touch.felt if isinstance(touch.felt, Grasp) else None for touch in touches]
    drawn = [None if g is None else (g.q, g.positions, g.normals) for g in felt]
    frames = _frames(rows, drawn)
    ends = [look["time"] for look in looks[1:]]
    for look, end in zip(looks, [*ends, *(look["time"] for look in looks[-1:])], strict=True):
        contacts = np.reshape(look["contacts"], (-1, 9))
        lines = (
            f"{look['phase']}: {look['load']:.2f} N carried",
            f"asked for {look['strength']:.1f} N a contact, in the mean",
            "felt " + (", ".join(f"{a:.1f}" for a in look["normal"]) + " N" * bool(len(contacts))),
            f"forces drawn {1e3 * CARRY_ARROW:g} mm a newton",
        )
        held = Held(contacts[:, 6:], np.array(look["object"]), end - look["time"], lines)
        last = frames[-1]
        q = np.array(look["q"]) if len(look["q"]) else last.q
        at = contacts[:, :3], contacts[:, 3:6]
        frames.append(Frame(q, *at, dict.fromkeys(ERRORS, np.nan), look["phase"], True, held))
    return frames


def frames_of(record: Record) -> list[Frame]:
    """The probes of a record, from the first touch on."""
    grasps = iter(record.grasps)
    felt = [next(grasps) if row["in_contact"] else None for row in record.rows]
    return _frames(
        record.rows, [None if g is None else (g.q, g.positions, g.normals) for g in felt]
    )


def frames_of_rows(rows: Sequence[Mapping[str, Any]], joints: Sequence[str]) -> list[Frame]:
    """The probes of one trial from its rows in probes.parquet, in order.

    A folder written before contacts were stored shows the robot without arrows.
    """
    missing = [f"q_{joint}" for joint in joints if rows and f"q_{joint}" not in rows[0]]
    if not rows or missing:
        what = f"columns {', '.join(missing)}" if missing else "rows"
        raise ResultsError(f"the results lack the {what} that a replay draws")
    felt = [_felt(row, joints) if row["in_contact"] else None for row in rows]
    return _frames(rows, felt)


def rows_of(table: pa.Table, trial: int) -> list[dict[str, Any]]:
    """One trial of a study's table, its rows in order."""
    rows = table.filter(pc.equal(table["trial"], trial)).to_pylist()
    if not rows:
        raise InputError(f"no trial {trial}; trials are 0 … {pc.max(table['trial']).as_py()}")
    return rows


_Felt = tuple[np.ndarray, np.ndarray, np.ndarray]  # q, positions, normals


def _felt(row: Mapping[str, Any], joints: Sequence[str]) -> _Felt:
    q = np.array([row[f"q_{joint}"] for joint in joints], dtype=float)
    contacts, i = [], 1
    while f"contact_{i}_x" in row:
        contacts.append([row[f"contact_{i}_{part}"] for part in CONTACT_COLUMNS])
        i += 1
    felt = [numbers for numbers in contacts if None not in numbers]
    values = np.array(felt, dtype=float).reshape(-1, 6)
    return q, values[:, :3], values[:, 3:]


def _frames(rows: Sequence[Mapping[str, Any]], felt: Sequence[_Felt | None]) -> list[Frame]:
    frames: list[Frame] = []
    last = next((f for f in felt if f is not None), None)
    if last is None:
        raise InputError("a trial that never touched has nothing to show")
    outcome = "lost"
    for row, new in zip(rows, felt, strict=True):
        last = new or last
        outcome = row["outcome"] or outcome  # rows after the end of a trial say nothing
        errors = {e: float("nan") if row.get(e) is None else float(row[e]) for e in ERRORS}
        frames.append(Frame(*last, errors, str(outcome), new is not None))
    return frames


def placed(scene: Scene, frames: Sequence[Frame]) -> Scene:
    """The scene with its robot where it touched.

    A hand without an arm is placed anew by the draw of each trial. Where is not stored, but its
    round tips were on their contacts: base and contacts are matched by least squares.
    """
    robot = scene.articulated
    if robot.arm:
        return scene
    frame = next(frame for frame in frames if frame.touched)
    tips = robot.centers(frame.q)
    if len(frame.positions) < 3 or len(frame.positions) != len(tips):
        raise InputError(
            f"{robot.description.name} has no arm, and is placed by its contacts, 3 at least; "
            f"{len(frame.positions)} are stored"
        )
    there = frame.positions + robot.tip_radius[:, None] * frame.normals
    U, _, Vt = np.linalg.svd((there - there.mean(axis=0)).T @ (tips - tips.mean(axis=0)))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt  # Kabsch's rotation
    p = there.mean(axis=0) - R @ tips.mean(axis=0)
    if np.abs(tips @ R.T + p - there).max() > PLACED:
        raise InputError(f"the tips of {robot.description.name} do not fit their contacts")
    return scene.rebased(p, R)


# ---------------------------------------------------------------- shapes


@dataclass(frozen=True, eq=False)
class Shape:
    """A part of one body in one colour, as triangles."""

    body: int
    colour: Colour
    opacity: float
    vertices: np.ndarray  # (v, 3) [m], body frame
    faces: np.ndarray  # (f, 3)


def shapes(model: mujoco.MjModel) -> list[Shape]:
    """What MuJoCo's own viewer shows, as triangles: one shape a body and colour.

    Planes and height fields are left out.
    """
    trimesh = _need("trimesh")
    found: dict[tuple[int, tuple[float, ...]], list[Any]] = {}
    for g in range(model.ngeom):
        material = model.geom_matid[g]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]
        mesh = _triangles(trimesh, model, g)
        if mesh is None or model.geom_group[g] >= GEOM_GROUPS or rgba[3] == 0.0:
            continue
        pose = np.eye(4)
        mujoco.mju_quat2Mat(matrix := np.empty(9), model.geom_quat[g])
        pose[:3, :3], pose[:3, 3] = matrix.reshape(3, 3), model.geom_pos[g]
        mesh.apply_transform(pose)
        key = (int(model.geom_bodyid[g]), tuple(float(c) for c in rgba))
        found.setdefault(key, []).append(trimesh.graph.smooth_shade(mesh, angle=CREASE))
    shapes = []
    for (body, rgba), meshes in found.items():
        red, green, blue = (round(255 * c) for c in rgba[:3])
        whole = trimesh.util.concatenate(meshes)
        shapes.append(Shape(body, (red, green, blue), rgba[3], whole.vertices, whole.faces))
    return shapes


def _triangles(trimesh: ModuleType, model: mujoco.MjModel, g: int) -> Any:
    """A geom in its own frame, or None for what has no surface of its own."""
    kind, size = mujoco.mjtGeom(model.geom_type[g]), model.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=3, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return trimesh.creation.icosphere(subdivisions=3).apply_scale(size)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[24, 24])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=40)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(2.0 * size)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        m = model.geom_dataid[g]
        v, f = model.mesh_vertadr[m], model.mesh_faceadr[m]
        return trimesh.Trimesh(
            model.mesh_vert[v : v + model.mesh_vertnum[m]],
            model.mesh_face[f : f + model.mesh_facenum[m]],
        )
    return None


# ---------------------------------------------------------------- drawing


class Drawing:
    """A scene drawn in viser; `show` puts it at one probe. A ghost is the robot alone, see-through.

    Arrows: the outward normal of each contact; the unit force with which each finger presses, from
    the contact inwards; and their sum, the net force, at the contacts' centroid.
    """

    def __init__(
        self, scene_api: Any, scene: Scene, name: str = "/hand", ghost: bool = False
    ) -> None:
        self._root = scene_api.add_frame(name, show_axes=False)
        self._thing = thing = scene.model.body(OBJECT).id
        self._bodies = {
            body: scene_api.add_frame(f"{name}/body_{body}", show_axes=False)
            for body in range(scene.model.nbody)
            if not (ghost and body == thing)
        }
        for i, shape in enumerate(shapes(scene.model)):
            if shape.body not in self._bodies:
                continue
            opacity = 0.3 if ghost else 0.35 if shape.body == thing else shape.opacity
            scene_api.add_mesh_simple(
                f"{name}/body_{shape.body}/shape_{i}",
                shape.vertices,
                shape.faces,
                color=GHOST_COLOUR if ghost else shape.colour,
                opacity=None if opacity == 1.0 else opacity,
                cast_shadow=False,
                receive_shadow=False,
            )
        self._arrows: dict[str, Any] = {}
        if not ghost:
            none = np.zeros((0, 2, 3))
            for kind, form in ARROWS.items():
                self._arrows[kind] = scene_api.add_arrows(f"{name}/{kind}", none, GREY, **form)
            self._felt = scene_api.add_point_cloud(
                f"{name}/felt",
                np.zeros((0, 3)),
                FELT_COLOUR,
                point_size=0.003,
                point_shape="circle",
                precision="float32",
            )

    @property
    def visible(self) -> bool:
        """Whether any of it is drawn."""
        return bool(self._root.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._root.visible = visible

    def show(self, robot: Robot, frames: Sequence[Frame], probe: int) -> None:
        """Draw a probe of the robot, `placed` for this trial, and all that was felt up to it."""
        frame = frames[probe]
        position, wxyz = robot.bodies(frame.q)
        if frame.held is not None:
            position, wxyz = position.copy(), wxyz.copy()
            position[self._thing], wxyz[self._thing] = frame.held.place[:3], frame.held.place[3:]
        for body, handle in self._bodies.items():
            handle.position, handle.wxyz = position[body], wxyz[body]
        if not self._arrows:
            return
        at, n = frame.positions, frame.normals
        if frame.held is not None:
            self._show_held(at, frame.held.forces)
            return
        centroid = at.mean(axis=0, keepdims=True) if len(at) else at
        net = -n.sum(axis=0, keepdims=True)
        if np.linalg.norm(net) * ARROW < ARROWS["net_force"]["head_length"]:
            centroid = net = np.zeros((0, 3))  # shorter than its own head
        self._arrow("normals", at, 1.25 * n, frame.touched, NORMAL_COLOUR)
        self._arrow("forces", at, -n, frame.touched, FORCE_COLOUR)
        self._arrow("net_force", centroid, net, frame.touched, NET_COLOUR)
        felt = [f.positions for f in frames[: probe + 1] if f.touched]
        _put(self._felt, "points", np.concatenate([np.zeros((0, 3)), *felt]).astype(np.float32))

    def _show_held(self, at: np.ndarray, forces: np.ndarray) -> None:
        """Draw the forces on what is held, and their sum; touches are not of its place any more."""
        none, scale = np.zeros((0, 3)), CARRY_ARROW / ARROW
        middle = at.mean(axis=0, keepdims=True) if len(at) else none
        self._arrow("normals", none, none, True, NORMAL_COLOUR)
        self._arrow("forces", at - scale * ARROW * forces, scale * forces, True, FORCE_COLOUR)
        net = scale * forces.sum(axis=0, keepdims=True) if len(at) else none
        self._arrow("net_force", middle, net, True, NET_COLOUR)
        _put(self._felt, "points", none.astype(np.float32))

    def _arrow(
        self, kind: str, start: np.ndarray, vector: np.ndarray, touched: bool, colour: Colour
    ) -> None:
        points = np.stack([start, start + ARROW * vector], axis=1).astype(np.float32)
        _put(self._arrows[kind], "points", points)
        _put(self._arrows[kind], "colors", np.array(colour if touched else GREY, dtype=np.uint8))


def _put(handle: Any, name: str, value: np.ndarray) -> None:
    """Set what changed: every message costs room in the file."""
    if not np.array_equal(getattr(handle, name), value):
        setattr(handle, name, value)


# ---------------------------------------------------------------- the file


def write_replay(
    scene: Scene, trial: Record | Sequence[Frame], path: str | Path, title: str = "replay"
) -> None:
    """Write one self-contained HTML file that plays the trial, a probe a second.

    Needs viser, else raises MissingExtraError; the file then needs nothing but a browser.
    """
    frames = frames_of(trial) if isinstance(trial, Record) else list(trial)
    if not frames:
        raise InputError("a replay needs at least one probe")
    path, scene = Path(path), placed(scene, frames)
    robot = scene.articulated
    with _quiet_server() as server:
        scene_api = server.scene
        light(scene_api)
        view = camera(scene, frames[0].q)
        aim(server, view, aside=0.45)
        drawing = Drawing(scene_api, scene)
        panel = _Panel(scene_api, frames, view, title)
        drawing.show(robot, frames, 0)
        recording = server.get_scene_serializer()
        for probe in range(len(frames)):
            drawing.show(robot, frames, probe)
            panel.show(probe)
            held = frames[probe].held
            recording.insert_sleep(SECONDS_A_PROBE if held is None else held.duration)
        page = recording.as_html()
    page = page.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1)
    with whole_file(path) as part:
        part.write_text(page, encoding="utf-8")


@contextlib.contextmanager
def _quiet_server() -> Iterator[Any]:
    """A viser server for the time of one recording; nobody connects, and it says nothing."""
    with contextlib.redirect_stdout(io.StringIO()):
        server = need_viser().ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            yield server
        finally:
            server.stop()


def need_viser() -> ModuleType:
    """The viser package, or MissingExtraError with the line that installs it."""
    return _need("viser")


def _need(package: str) -> ModuleType:
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise missing("view", package) from error


def light(scene_api: Any) -> None:
    """Plain lamps: an environment map and shadows would keep a browser without a GPU waiting."""
    scene_api.configure_environment_map(None)
    scene_api.configure_default_lights(enabled=False, cast_shadow=False)
    scene_api.add_light_hemisphere("/lamps/sky", ground_color=(150, 150, 150), intensity=2.2)
    scene_api.add_light_directional("/lamps/sun", position=(-0.3, -1.0, 1.5), intensity=1.6)


@dataclass(frozen=True, eq=False)
class Camera:
    """Where one looks from."""

    middle: np.ndarray  # (3,) [m] what is looked at
    size: float  # [m] how much is seen, from side to side of the hand
    axes: np.ndarray  # (3, 3) rows: right, up, and back towards the eye


def camera(scene: Scene, q: np.ndarray) -> Camera:
    """A view of hands and object from the side."""
    thing, robot = np.array(scene.position), scene.articulated
    palms = np.array([robot.palm(q, g)[0] for g in range(len(robot.groups))])
    back = VIEW_FROM / np.linalg.norm(VIEW_FROM)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    size = max(0.3, 2.0 * float(np.linalg.norm(palms - thing, axis=1).max()))
    return Camera(
        0.5 * (thing + palms.mean(axis=0)), size, np.array([right, np.cross(back, right), back])
    )


def aim(server: Any, camera: Camera, aside: float, distance: float = 2.2) -> None:
    """Begin with this view, its middle `aside` to the left; both in sizes of the camera."""
    at = camera.middle + aside * camera.size * camera.axes[0]
    server.initial_camera.fov = np.radians(35.0)
    server.initial_camera.position = at + distance * camera.size * camera.axes[2]
    server.initial_camera.look_at = at


class _Panel:
    """Beside the hand: the errors over the probes, a line where we are, this probe's numbers."""

    def __init__(self, scene_api: Any, frames: Sequence[Frame], camera: Camera, title: str) -> None:
        self._frames, self._title = frames, title
        figure = errors_figure([frame for frame in frames if frame.held is None])
        canvas = FigureCanvasAgg(figure)  # a canvas of its own: no display is needed
        canvas.draw()
        image = np.asarray(canvas.buffer_rgba())[..., :3]
        width = 0.9 * camera.size
        height = width * image.shape[0] / image.shape[1]
        # From the figure's coordinates, origin below left, to the plane's, y downwards.
        self._on_plane = lambda x, y: ((x - 0.5) * width, (0.5 - y) * height, -1e-3)
        self._axes = [(axes, axes.get_position()) for axes in figure.axes]
        right, up, back = camera.axes
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, np.array([right, -up, -back]).T.ravel())
        place = camera.middle + 1.0 * camera.size * right - 0.12 * camera.size * up
        scene_api.add_frame("/errors", position=place, wxyz=turn, show_axes=False)
        scene_api.add_image(
            "/errors/plot", image, width, height, format="png", receive_shadow=False
        )
        self._line = scene_api.add_line_segments(
            "/errors/now", self._now(0), (40, 40, 40), thickness=2.0, thickness_units="screen"
        )
        self._label = scene_api.add_label(
            "/errors/numbers",
            self._text(0),
            position=self._on_plane(0.0, 1.05),
            anchor="bottom-left",
            font_screen_scale=1.3,
        )

    def show(self, probe: int) -> None:
        """Move the line to the probe and write its numbers."""
        _put(self._line, "points", self._now(probe))
        self._label.text = self._text(probe)

    def _now(self, probe: int) -> np.ndarray:
        points = []
        for axes, box in self._axes:
            low, high = axes.get_xlim()
            probe = min(probe, int(high))  # what is held has no errors: the line stays at the last
            x = box.x0 + box.width * (probe - low) / (high - low)
            points.append([self._on_plane(x, box.y0), self._on_plane(x, box.y1)])
        return np.array(points, dtype=np.float32)

    def _text(self, probe: int) -> str:
        return "\n".join([self._title, *describe(self._frames, probe)])


def describe(frames: Sequence[Frame], probe: int) -> list[str]:
    """A probe in a few lines: its number, its errors with units, how it ended."""
    frame = frames[probe]
    if frame.held is not None:
        return list(frame.held.lines)
    probes = sum(frame.held is None for frame in frames)
    lines = [f"probe {probe} of {probes - 1}: {frame.outcome}"]
    if frame.touched:
        e = frame.errors
        lines += [
            f"net force²  ε_f = {e['eps_f']:.2e} N²",
            f"net moment  √ε_m = {1e3 * np.sqrt(e['eps_m']):.2e} mm·N",
            f"flexion angle  ε_k = {e['eps_k']:.3f} rad",
        ]
        if not np.isnan(e["friction_demand"]):  # older folders lack it
            lines.append(holds(e["friction_demand"]))
    return lines


def errors_figure(frames: Sequence[Frame]) -> Figure:
    """The errors of one trial over its probes; what the arrows' colours mean stands below."""
    force, moment, angle = (np.array([f.errors[e] for f in frames]) for e in ERRORS[:3])
    figure = Figure(figsize=(4.2, 3.9), dpi=200, facecolor="white")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    figure.subplots_adjust(left=0.16, right=0.97, top=0.97, bottom=0.24, hspace=0.08)
    top.semilogy(np.maximum(force, FLOOR), ".-", color=FORCE, label=r"$\varepsilon_f$ [N²]")
    moment = 1e3 * np.sqrt(moment)
    top.semilogy(
        np.maximum(moment, FLOOR), ".-", color=MOMENT, label=r"$\sqrt{\varepsilon_m}$ [mm·N]"
    )
    top.axhline(CONVERGED_FORCE, color=FORCE, ls=":", lw=1)
    top.axhline(1e3 * CONVERGED_MOMENT, color=MOMENT, ls=":", lw=1)
    top.legend()
    bottom.plot(angle, ".-", color=ANGLE)
    bottom.set(xlabel="probe", ylabel=r"$\varepsilon_k$ [rad]", ylim=(0.0, None))
    bottom.set_xlim(-0.5, len(frames) - 0.5)
    words = (
        ("normal", NORMAL_COLOUR),
        ("unit force", FORCE_COLOUR),
        ("net force", NET_COLOUR),
        ("felt so far", FELT_COLOUR),
    )
    for i, (word, colour) in enumerate(words):
        figure.text(0.06 + 0.23 * i, 0.03, f"● {word}", color=np.array(colour) / 255.0, fontsize=9)
    return figure
