"""The objects that a scene can hold: cylinders, prisms, and bodies read from a file."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hqp_grasp.errors import InputError, instance, positive, whole
from hqp_grasp.world.compiling import compiled_spec
from hqp_grasp.world.description import locate

OBJECT = "object"  # name of the object's body and of its first geom in a scene
OBJECT_COLOUR = (0.85, 0.55, 0.25, 1.0)
LARGEST = 1.0  # [m] no hand here grasps more, so the file has other units
SMALLEST = 0.005  # [m] nor less
CONVEX = 0.9  # [–] share of its convex hull that a mesh fills, below which its user is told
TURN = 1e-9  # [–] sine of the least turn at a corner
GEOMS = {
    int(kind): kind
    for kind in (
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_MESH,
    )
}
MESHES = (".obj", ".stl")


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder."""

    steepest: ClassVar[float] = 0.05  # [–] vertical part of a normal of the side, at most
    radius: float  # [m]
    height: float = 0.12  # [m]

    def __post_init__(self) -> None:
        for name in ("radius", "height"):
            value = positive(f"Cylinder.{name}", getattr(self, name))
            object.__setattr__(self, name, value)

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
        """Put the geom into `body`, centred."""
        body.add_geom(
            name=OBJECT,
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[self.radius, self.height / 2.0, 0.0],
            rgba=OBJECT_COLOUR,
        )


@dataclass(frozen=True)
class Prism:
    """An upright prism over a convex polygon, its corners counter-clockwise around the origin."""

    steepest: ClassVar[float] = 0.05  # [–] vertical part of a normal of the side, at most
    polygon: tuple[tuple[float, float], ...]  # (m, 2) [m]
    height: float = 0.12  # [m]

    def __post_init__(self) -> None:
        object.__setattr__(self, "height", positive("Prism.height", self.height))
        try:
            corners = np.asarray(self.polygon, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"Prism.polygon must be corners (x, y); got {self.polygon!r}"
            ) from error
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InputError(f"Prism.polygon needs at least 3 corners (x, y); got {self.polygon!r}")
        if not np.isfinite(corners).all():
            raise InputError("Prism.polygon must be finite")
        fault = _fault(corners)
        if fault:
            raise InputError(f"Prism.polygon {fault}")
        following = np.roll(corners, -1, axis=0)
        if not (_cross(corners, following) > 0.0).all():
            raise InputError(
                "Prism.polygon must go around the origin; Prism.centred moves it there"
            )
        object.__setattr__(self, "polygon", tuple((float(x), float(y)) for x, y in corners))

    @classmethod
    def regular(cls, sides: int, side: float, height: float = 0.12) -> Prism:
        """A regular polygon with sides of `side` [m], one corner on the x axis."""
        side, sides = positive("Prism side", side), whole("the number of a Prism's sides", sides, 3)
        angles = 2.0 * np.pi * np.arange(sides) / sides
        radius = side / (2.0 * np.sin(np.pi / sides))
        corners = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        return cls(tuple(map(tuple, corners)), height)

    @classmethod
    def box(cls, x: float, y: float, z: float) -> Prism:
        """A box with sides of these lengths [m] along the axes."""
        x, y = positive("Prism.box x", x) / 2.0, positive("Prism.box y", y) / 2.0
        return cls(((-x, -y), (x, -y), (x, y), (-x, y)), z)

    @classmethod
    def centred(cls, corners: np.ndarray, height: float = 0.12) -> Prism:
        """The prism over `corners` (m, 2) [m], wherever they lie: their centroid is its middle."""
        return cls(tuple(map(tuple, corners - centroid(corners))), height)

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
        """Put the geom into `body`, centred."""
        half = self.height / 2.0
        corners = [(x, y, z) for z in (-half, half) for x, y in self.polygon]
        spec.add_mesh(name=OBJECT, uservert=np.ravel(corners))
        body.add_geom(
            name=OBJECT, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=OBJECT, rgba=OBJECT_COLOUR
        )


def read_corners(file: str | Path, scale: float = 1.0) -> np.ndarray:
    """Corners (m, 2) [m] of an outline: CSV, a corner x,y a line, counter-clockwise.

    The first line may be a header; `scale` is the file's unit [m]. Raises InputError for what is
    no strictly convex outline of a size to grasp, naming the line.
    """
    scale = positive("scale", scale)
    path = Path(file)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read corners from {path}: {_reason(error)}") from error
    numbers: list[int] = []
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(lines, start=1):
        cells = line.split(",")
        if not line.strip():
            continue
        try:
            x, y = map(float, cells)
        except ValueError:
            if not numbers and number == 1 and not any(map(_is_number, cells)):
                continue  # a header
            raise InputError(f"{path}, line {number}: {line!r} is no corner x,y") from None
        if not (np.isfinite(x) and np.isfinite(y)):
            raise InputError(f"{path}, line {number}: {line!r} is not finite")
        numbers.append(number)
        rows.append((x, y))
    if len(rows) < 3:
        raise InputError(f"{path} holds {len(rows)} corners; an outline has at least 3")
    corners = scale * np.array(rows)
    fault = _fault(corners, numbers)
    if fault:
        raise InputError(f"{path} {fault}")
    _require_size(path, np.ptp(corners, axis=0))
    return corners


def centroid(corners: np.ndarray) -> np.ndarray:
    """Centroid of the area (2,) [m] inside `corners` (m, 2)."""
    corners = np.asarray(corners, dtype=float)
    about = corners.mean(axis=0)
    a, b = corners - about, np.roll(corners, -1, axis=0) - about
    area = _cross(a, b)
    return about + area @ (a + b) / (3.0 * area.sum())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _fault(corners: np.ndarray, lines: list[int] | None = None) -> str:
    """Why `corners` (m, 2) are no strictly convex outline, counter-clockwise; empty where they are.

    Corners are named by their line, or else by their place from 1.
    """
    name = (lambda i: f"line {lines[i]}") if lines else (lambda i: f"{i + 1}")
    m = len(corners)
    for i in range(m):
        for j in range(i):
            if (corners[i] == corners[j]).all():
                closing = i == m - 1 and j == 0
                way = "; the outline closes by itself, leave the last out" if closing else ""
                return f"repeats the corner of {name(j)} in {name(i)}{way}"
    edges = np.roll(corners, -1, axis=0) - corners
    edges = edges / np.linalg.norm(edges, axis=1)[:, None]
    turns = _cross(np.roll(edges, 1, axis=0), edges)  # at each corner
    if (turns < 0.0).all():
        return "runs clockwise; list its corners counter-clockwise"
    dents = np.flatnonzero(turns <= TURN)
    if len(dents):
        x, y = corners[dents[0]]
        return f"is not strictly convex at ({x:g}, {y:g}), the corner of {name(dents[0])}"
    if np.arctan2(turns, (np.roll(edges, 1, axis=0) * edges).sum(axis=1)).sum() > 3.0 * np.pi:
        return "is not strictly convex: it goes around more than once"
    return ""


@dataclass(frozen=True)
class _Piece:
    """One geom of a body, in the body's frame [m]."""

    kind: int  # mjtGeom
    felt: bool  # or only drawn
    rgba: tuple[float, ...]
    size: np.ndarray  # (3,)
    position: np.ndarray  # (3,)
    quaternion: np.ndarray  # (4,)
    vertices: np.ndarray  # (v, 3), empty but for a mesh
    faces: np.ndarray  # (f, 3)
    box: np.ndarray  # (c, 3) points whose bounding box holds the piece

    def moved(self, by: np.ndarray, scale: float) -> _Piece:
        """The same, at scale · (x + by)."""
        move = lambda x: scale * (x + by)  # noqa: E731
        return _Piece(
            self.kind, self.felt, self.rgba, scale * self.size, move(self.position),
            self.quaternion, move(self.vertices), self.faces, move(self.box),
        )  # fmt: skip


@dataclass(frozen=True)
class Body:
    """An object from a file: an MJCF that holds one, or a mesh (.obj, .stl), its z axis upwards.

    Its geoms are convex, as MuJoCo takes them: of a mesh the convex hull is felt, and a warning
    says so where the mesh fills less than CONVEX of it. Geoms that collide with nothing are
    drawn, not felt. The middle of the box around what is felt stands at the scene's position.

    `file` is a path, or package:path in an installed package, which is not imported.
    `scale` is the file's unit [m], 0.001 for a file in millimetres. `content` is a hash of the
    shapes, so that a file which has changed is another object; give it to ask for that very one.
    """

    steepest: ClassVar[float] = 0.5  # [–] the side of a rounded object leans: 30° up or down
    file: str | Path
    scale: float = 1.0
    content: str = ""
    _pieces: tuple[_Piece, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", positive("Body.scale", self.scale))
        instance("Body.content", self.content, str)
        if not isinstance(self.file, str | Path) or not str(self.file):
            raise InputError(f"Body.file must be the path of an MJCF or a mesh; got {self.file!r}")
        path = locate(str(Path(self.file).expanduser()), Path.cwd()).absolute()
        pieces = _load(path)
        felt = [piece for piece in pieces if piece.felt]
        if not felt:
            raise InputError(f"{path}: its geoms collide with nothing, so there is none to feel")
        points = np.concatenate([piece.box for piece in felt])
        _require_size(path, self.scale * np.ptp(points, axis=0))
        middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        for piece in felt:
            _tell_of_hollows(path, piece)
        pieces = [piece.moved(-middle, self.scale) for piece in pieces]
        content = _hash(pieces)
        if self.content not in ("", content):
            raise InputError(f"{path} has changed: its content is {content}, not {self.content}")
        object.__setattr__(self, "file", str(path))
        object.__setattr__(self, "content", content)
        object.__setattr__(self, "_pieces", tuple(pieces))

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
        """Put the geoms into `body`, the middle of what is felt at its origin."""
        felt = 0
        for i, piece in enumerate(self._pieces):
            name = f"{OBJECT}_drawn_{i}"
            if piece.felt:
                name = f"{OBJECT}_{felt}" if felt else OBJECT
                felt += 1
            geom = body.add_geom(name=name, type=GEOMS[piece.kind], rgba=piece.rgba)
            if not piece.felt:
                geom.contype = geom.conaffinity = 0
            if len(piece.vertices):
                # A shell's inertia asks nothing of the faces, and none is read here.
                spec.add_mesh(
                    name=name,
                    uservert=piece.vertices.ravel(),
                    userface=piece.faces.ravel(),
                    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
                )
                geom.meshname = name
            else:
                geom.size, geom.pos, geom.quat = piece.size, piece.position, piece.quaternion


def _load(path: Path) -> list[_Piece]:
    """The geoms of a file, in its own frame and units."""
    if not path.is_file():
        raise InputError(f"no file {path}")
    mesh = path.suffix.lower() in MESHES
    if not mesh and path.suffix.lower() != ".xml":
        raise InputError(
            f"{path.name}: an object is an MJCF (.xml) or a mesh ({', '.join(MESHES)})"
        )
    try:
        if mesh:
            spec = mujoco.MjSpec()
            spec.add_mesh(
                name=OBJECT, file=str(path), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            )
            spec.worldbody.add_body(name=OBJECT).add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=OBJECT, rgba=OBJECT_COLOUR
            )
        else:
            spec = mujoco.MjSpec.from_file(str(path))
            for each in spec.meshes:
                each.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    except (ValueError, OSError) as error:
        raise InputError(f"MuJoCo cannot read {path}: {_reason(error)}") from error
    model = compiled_spec(spec, f"MuJoCo cannot read {path}")
    _require_one_rigid_object(path, model)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    pieces = [_piece(path, model, data, g) for g in range(model.ngeom)]
    if mesh:
        _require_closed(path, pieces[0])
    return pieces


def _require_one_rigid_object(path: Path, model: mujoco.MjModel) -> None:
    holders = model.body_rootid[model.geom_bodyid]
    roots = sorted(set(holders.tolist()))
    if len(roots) != 1:
        names = ", ".join(repr(model.body(r).name or "the world") for r in roots) or "none"
        raise InputError(f"{path} must hold one object; the bodies in it that have geoms: {names}")
    for j in range(model.njnt):
        if model.jnt_type[j] != int(mujoco.mjtJoint.mjJNT_FREE):
            raise InputError(
                f"{path}: an object is one rigid piece; joint {model.joint(j).name!r} moves in it"
            )


def _piece(path: Path, model: mujoco.MjModel, data: mujoco.MjData, g: int) -> _Piece:
    kind = int(model.geom_type[g])
    felt = bool(model.geom_contype[g] or model.geom_conaffinity[g])
    if kind not in GEOMS:
        valid = ", ".join(k.name.removeprefix("mjGEOM_").lower() for k in GEOMS.values())
        raise InputError(f"{path}: geom {model.geom(g).name or g} must be one of: {valid}")
    p, R = data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3)
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
    middle, half = model.geom_aabb[g, :3], model.geom_aabb[g, 3:]
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    box = middle + signs * half
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        mesh = model.geom_dataid[g]
        first, many = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = p + model.mesh_vert[first : first + many].astype(float) @ R.T
        first, many = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        faces = model.mesh_face[first : first + many].copy()
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, R.ravel())
    rgba = tuple(float(c) for c in model.geom_rgba[g])
    grey = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's, where the file says nothing
    return _Piece(
        kind,
        felt,
        OBJECT_COLOUR if np.allclose(rgba, grey) else rgba,
        model.geom_size[g].copy(),
        p.copy(),
        quaternion,
        vertices,
        faces,
        vertices if len(vertices) else p + box @ R.T,
    )


def _open_edges(piece: _Piece) -> int:
    """Directed edges of a mesh that no face runs back along; none where it is closed."""
    _, merged = np.unique(piece.vertices.astype(np.float32), axis=0, return_inverse=True)
    faces = merged.reshape(-1)[piece.faces].astype(np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = len(piece.vertices)
    there, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    names, inverse = np.unique(np.concatenate([there, back]), return_inverse=True)
    net = np.zeros(len(names), dtype=int)
    np.add.at(net, inverse[: len(there)], 1)
    np.add.at(net, inverse[len(there) :], -1)
    return int(np.maximum(net, 0).sum())


def _require_closed(path: Path, piece: _Piece) -> None:
    gaps = _open_edges(piece)
    if gaps:
        raise InputError(
            f"{path} is not closed: {gaps} of its edges have a face on one side only, or faces "
            "turned inside out; close it, or write an MJCF of convex geoms"
        )


def _tell_of_hollows(path: Path, piece: _Piece) -> None:
    """Warn where the convex hull, which is felt, is not what the mesh shows."""
    if not len(piece.vertices):
        return
    try:
        hull = float(ConvexHull(piece.vertices).volume)
    except QhullError as error:
        raise InputError(f"{path}: a mesh in it is flat") from error
    if _open_edges(piece):
        told = "is not closed"
    else:
        a, b, c = (piece.vertices[piece.faces[:, i]] for i in range(3))
        share = abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6.0 / hull
        if share >= CONVEX:
            return
        told = f"fills {share:.0%} of its convex hull"
    warnings.warn(
        f"{path.name}: a mesh {told}; the hull is what is felt. Split it into convex geoms, in an "
        "MJCF, where that is too much",
        stacklevel=4,
    )


def _require_size(path: Path, extents: np.ndarray) -> None:
    """Raise InputError for what is too large or too small to be grasped."""
    size = " × ".join(f"{extent:.3g}" for extent in extents)
    if max(extents) > LARGEST:
        raise InputError(
            f"{path} is {size} m large, out of any hand's reach; is it in millimetres? Then say "
            "--scale 0.001"
        )
    if max(extents) < SMALLEST:
        raise InputError(f"{path} is {size} m large, too small to be grasped; say --scale")


def _hash(pieces: list[_Piece]) -> str:
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(f"{piece.kind} {piece.felt} {piece.rgba}".encode())
        for array in (piece.size, piece.position, piece.quaternion, piece.vertices, piece.faces):
            digest.update(array.tobytes())
    return f"sha256:{digest.hexdigest()}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _reason(error: Exception) -> str:
    """What an error says, in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return " ".join(str(error).split())
