"""What a robot is, as its robot.toml says: model files, hands, and what to change in the files."""

from __future__ import annotations

import difflib
import math
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata, resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, ModelError, one_of, positive
from hqp_grasp.grasp import as_array
from hqp_grasp.world.compiling import compiled_spec, read_afresh

INF = math.inf
SPEED, SLIDE_SPEED = 1.0, 0.25  # [rad/s], [m/s] of joints for which a description gives none
CLEARANCE = 0.005  # [m] that links keep between them
MODELS = (".xml", ".mjcf", ".urdf")  # files with a robot in them
MESHES = (".stl", ".obj", ".msh")  # what MuJoCo loads
# Nearest points of meshes and boxes: with MuJoCo's defaults their direction is off by 4e-3 at a gap
# of 1e-6 m, with these by 2e-6 down to 1e-9 m. For balls, whose centre gives the direction, the
# defaults do.
CCD_TOLERANCE, CCD_ITERATIONS = 1e-12, 200
CARRIAGE = tuple(f"carriage_{axis}" for axis in ("x", "y", "z", "yaw", "pitch", "roll"))
CARRIAGE_PITCH = np.radians(40.0)  # of the approach axis below the horizontal, at zero
CARRIAGE_RANGES = ((-2.0, 2.0),) * 3 + ((-2.6, 2.6), (-1.4, 1.4), (-2.6, 2.6))  # [m], [rad]
FREE, BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
SIZES = {FREE: 7, BALL: 4}  # numbers that place a joint; others take one
START = (
    "adduction",
    "elevation",
    "offset",
    "facing",
    "lean",
    "advance",
    "joints",
)  # of the drawn first postures
KEYS = {  # of each table; a key that is none of these is refused
    "file": (
        *("file", "root", "prefix", "at", "pos", "quat", "rpy"),
        *("degrees", "balanceinertia", "fusestatic", "package_root"),
    ),
    "group": ("name", "palm", "arm", "adduction", "contact_points"),
    "hand": ("groups", "home", "start"),
    "palm": ("body", "pos", "approach", "opposition"),
    "contact point": (
        *("name", "link", "geom", "geoms", "ball", "site", "flexion"),
        *("force", "torque"),
    ),
    "ball": ("pos", "radius"),
    "coupling": ("joint", "to", "ratio", "offset"),
    "start": START,
}
TOP = (
    *("model", "root", "description", "home", "speed", "velocity", "lock", "couplings"),
    *("drop_couplings", "ranges", "carriage", "workspace", "clearance", "start"),
    *("groups", "hands", *KEYS["group"][1:]),
)


@dataclass(frozen=True)
class ModelFile:
    """One MJCF or URDF of a robot, and where it is joined to those before it."""

    file: Path
    prefix: str = ""  # before all its names
    at: str = ""  # body that carries it, "" the world
    pos: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m] in that body's frame
    quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)  # w x y z
    degrees: bool | None = None  # what the file's angles are in; None: as it says itself
    balanceinertia: bool | None = None  # None: only for a URDF
    fusestatic: bool | None = None  # None: never for a URDF, whose fixed links would melt away
    package_root: Path | None = None  # folder that package:// stands for; None: looked for
    root: str = ""  # of its root bodies, the one that is the robot; "": all that the file holds

    @property
    def is_urdf(self) -> bool:
        return self.file.suffix.lower() == ".urdf"

    @property
    def stands_alone(self) -> bool:
        """Neither placed nor renamed."""
        plain = ModelFile(self.file)
        return all(getattr(self, n) == getattr(plain, n) for n in ("prefix", "at", "pos", "quat"))

    def spec(self) -> mujoco.MjSpec:
        """The file alone, as MuJoCo reads it, every body and joint with a name."""
        spec = self._whole()
        if self.root:
            roots = [body.name for body in spec.worldbody.bodies]
            _known("root body", self.root, roots, f"root of {self.file.name}")
            others = [body for body in spec.worldbody.bodies if body.name != self.root]
            for thing in (*others, *spec.worldbody.geoms):
                spec.delete(thing)  # and what refers to it
        return spec

    def keyframes(self) -> dict[str, dict[str, tuple[float, ...]]]:
        """The coordinates of each joint in each keyframe [rad, m], by name.

        A keyframe may list none: joints are then where the file puts them.
        """
        spec = self._whole()
        ends = np.cumsum([SIZES.get(joint.type, 1) for joint in spec.joints]).tolist()
        names = [joint.name for joint in spec.joints]
        kept = {joint.name for joint in self.spec().joints} if self.root else set(names)
        return {
            key.name: {
                self.prefix + name: tuple(np.array(key.qpos)[start:end].tolist())
                for name, start, end in zip(names, [0, *ends], ends, strict=False)
                if len(key.qpos) and name in kept
            }
            for key in spec.keys
        }

    def _whole(self) -> mujoco.MjSpec:
        """All that the file holds."""
        read_afresh()
        try:
            if self.is_urdf:
                spec = mujoco.MjSpec.from_string(self._urdf())
                spec.compiler.balanceinertia = self.balanceinertia is not False
                spec.compiler.fusestatic = self.fusestatic is True
            else:
                spec = mujoco.MjSpec.from_file(str(self.file))
                if self.balanceinertia is not None:
                    spec.compiler.balanceinertia = self.balanceinertia
                if self.fusestatic is not None:
                    spec.compiler.fusestatic = self.fusestatic
            _name(spec)
        except ModelError:  # a ValueError too, and says more
            raise
        except (ValueError, ET.ParseError) as error:
            kind = "URDF" if self.is_urdf else "MJCF"
            raise ModelError(f"{self.file} is not a valid {kind}: {error}") from error
        # A frame without mass cannot be moved in MuJoCo; nothing here depends on so little.
        spec.compiler.boundmass = max(spec.compiler.boundmass, 1e-9)
        spec.compiler.boundinertia = max(spec.compiler.boundinertia, 1e-12)
        if self.degrees is not None:
            spec.compiler.degree = self.degrees
        elif not self.is_urdf and spec.compiler.degree:
            self._refuse_radians(spec)
        self._refuse_keyframes(spec)
        return spec

    def _refuse_keyframes(self, spec: mujoco.MjSpec) -> None:
        """Raise for keyframes that MuJoCo fills with zeros or passes on, without a word."""
        size = sum(SIZES.get(joint.type, 1) for joint in spec.joints)
        for key in spec.keys:
            where = f"keyframe {key.name!r} of {self.file.name}"
            if len(key.qpos) not in (0, size):
                raise ModelError(
                    f"{where} has {len(key.qpos)} numbers; the model's {len(spec.joints)} joints "
                    f"take {size}"
                )
            if not np.isfinite(key.qpos).all():
                raise ModelError(f"{where} has qpos {np.array(key.qpos)}, not all finite")

    def unusable_ranges(self, spec: mujoco.MjSpec) -> dict[str, tuple[float, float]]:
        """Of each joint that MuJoCo would leave without range, as the file's is none [rad, m]."""
        if self.is_urdf:
            stated = {
                joint.get("name")
                for joint in ET.parse(self.file).getroot().iter("joint")
                if joint.get("type") in ("revolute", "prismatic")
                for limit in joint.findall("limit")
                if {"lower", "upper"} & set(limit.keys())
            }
        else:
            off = mujoco.mjtLimited.mjLIMITED_FALSE
            stated = {j.name for j in spec.joints if j.limited != off and j.range.any()}
        slide, unit = mujoco.mjtJoint.mjJNT_SLIDE, _angle_unit(spec)
        return {
            joint.name: tuple(joint.range * (1.0 if joint.type == slide else unit))
            for joint in spec.joints
            if joint.name in stated and not joint.range[0] < joint.range[1]
        }

    def _refuse_radians(self, spec: mujoco.MjSpec) -> None:
        """Raise where a file that does not name its unit lists radians: MuJoCo takes degrees."""
        hinges = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
        ends = [abs(end) for joint in hinges for end in joint.range]
        if ends and 0.0 < max(ends) < 2.0 * np.pi:
            joint = max(hinges, key=lambda j: max(abs(j.range)))
            raise ModelError(
                f"{self.file.name} does not say what its angles are in, and MuJoCo then reads "
                f"degrees: joint {joint.name!r} would turn within {joint.range.tolist()} degrees, "
                "hundredths of a radian; say degrees = false (or true, if it is right)"
            )

    def _urdf(self) -> str:
        """The URDF without what is only for the eye, its meshes by their absolute paths."""
        if not self.file.is_file():
            raise ModelError(f"{self.file} is not a valid URDF: there is no such file")
        root = ET.parse(self.file).getroot()
        for link in root.iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
            for mesh in link.iter("mesh"):
                path = self._mesh(mesh.get("filename", ""), link.get("name", ""))
                mesh.set("filename", str(path))
        compiler = '<mujoco><compiler strippath="false"/></mujoco>'
        root.insert(0, ET.fromstring(compiler))
        return ET.tostring(root, encoding="unicode")

    def _mesh(self, name: str, link: str) -> Path:
        """The file of a collision mesh; package:// begins at the root, or in a folder above."""
        here = self.file.parent
        if name.startswith("package://"):
            inside = name.removeprefix("package://")
            roots = [self.package_root] if self.package_root else list(here.resolve().parents)
            # A package's folder often is not named as the package.
            shorter = inside.partition("/")[2]
            places = [r / part for part in (inside, shorter) for r in roots]
        else:
            places = [here / name.removeprefix("file://")]
        found = next((path for path in places if path.is_file()), None)
        if found is None:
            raise ModelError(
                f"{self.file.name}: link {link!r} has the mesh {name!r}, which is at none of "
                f"{', '.join(map(str, places[:3]))}; say where package:// begins: "
                'package_root = "FOLDER"'
            )
        if found.suffix.lower() not in MESHES:
            raise ModelError(
                f"{self.file.name}: the collision mesh of link {link!r} is {found.name}, which "
                f"MuJoCo cannot load; convert it to one of {', '.join(MESHES)}, or take a URDF "
                "with simpler collision shapes"
            )
        return found


@dataclass(frozen=True)
class Palm:
    """A palm: a site of the model, or a place on a body with two axes."""

    site: str = ""  # z is the approach axis, x the opposition axis
    body: str = ""
    pos: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m] in the body's frame
    approach: tuple[float, ...] = (0.0, 0.0, 1.0)  # out of the palm, in the body's frame
    opposition: tuple[float, ...] = (1.0, 0.0, 0.0)  # along which fingers oppose one another


@dataclass(frozen=True)
class ContactPoint:
    """A place on the robot that may touch: the geoms of one link, or some of them."""

    name: str
    link: str = ""  # body; its geoms that collide touch, and those of bodies welded to it
    geoms: tuple[str, ...] = ()  # only these of them
    site: str = ""  # at the centre of the one geom, a sphere
    ball: tuple[float, ...] | None = None  # (4,) [m] centre in the link's frame, and radius
    closing: Mapping[str, float] | None = None  # signed weight of each joint that closes it
    by_arm: bool = False  # the arm closes it, along the palm's approach axis
    force: str = ""  # sensors
    torque: str = ""

    @property
    def flexion(self) -> tuple[str, ...]:
        """The joints that press it."""
        return tuple(self.closing or ())


@dataclass(frozen=True)
class Group:
    """Contact points on a palm that an arm carries, such as a hand's fingertips."""

    name: str
    contact_points: tuple[ContactPoint, ...]
    palm: Palm | None = None
    arm: tuple[str, ...] | None = None  # joints that carry the palm
    adduction: str | None = None  # joint that spreads the fingers


@dataclass(frozen=True)
class Hand:
    """What grasps together: one group, or several, each on an arm of its own."""

    name: str
    groups: tuple[str, ...]
    home: Mapping[str, float] = field(default_factory=dict)  # [rad] in place of the robot's
    start: Mapping[str, Any] = field(default_factory=dict)  # ranges of a Start


@dataclass(frozen=True)
class Coupling:
    """joint = ratio · to + offset."""

    joint: str
    to: str
    ratio: float = 1.0
    offset: float = 0.0  # [rad]


@dataclass(frozen=True)
class RobotDescription:
    """What a robot.toml says, defaults filled in (see docs/any-robot.md)."""

    name: str
    files: tuple[ModelFile, ...]
    groups: tuple[Group, ...]
    hands: tuple[Hand, ...] = ()  # each group by its own name, and what `hands` adds
    hand_name: str = ""  # the one that grasps; "": the first
    home: Mapping[str, float] = field(default_factory=dict)  # [rad], of a table or a keyframe
    bases: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    # (7,) of each free base in that keyframe: [m], w x y z
    speed: float | None = None  # [rad/s] of joints that `velocity` leaves out
    velocity: Mapping[str, float] = field(default_factory=dict)  # [rad/s]
    lock: tuple[str, ...] = ()  # joints that stay at home
    couplings: tuple[Coupling, ...] = ()
    drop_couplings: bool | tuple[str, ...] = ()  # names of equalities or of joints; True: all
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # [rad]
    carriage: bool = False  # six joints that carry all
    workspace: tuple[float, ...] | None = None  # (3,) [m] where an object stands
    clearance: float = CLEARANCE  # [m] that links keep between them; 0: they need not
    start: Mapping[str, Any] = field(default_factory=dict)  # ranges of a Start

    @classmethod
    def load(cls, robot: str | Path, hand: str | None = None) -> RobotDescription:
        """Read a robot of this package by name; any folder with a robot.toml, or file, by path."""
        path = _find(robot)
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise ModelError(
                f"{path} is not UTF-8, as TOML must be: byte {error.start} is "
                f"0x{error.object[error.start]:02x}; save it in that encoding"
            ) from error
        except OSError as error:
            raise ModelError(f"{path} cannot be read: {error.strerror}") from error
        return cls.read(text, path, hand)

    @classmethod
    def read(cls, text: str, path: Path, hand: str | None = None) -> RobotDescription:
        """What `text` says, as if it stood in the file `path`."""
        try:
            data = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ModelError(f"{path} is not valid TOML: {error}") from error
        try:
            about = _description(path, data)
        except KeyError as error:
            raise ModelError(f"{path} lacks the entry {error}") from error
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
        except (TypeError, AttributeError, InputError) as error:
            raise ModelError(f"{path}: an entry is of the wrong kind: {error}") from error
        if hand is not None:
            one_of(f"hand of {about.name}", hand, [h.name for h in about.hands])
            about = replace(about, hand_name=hand)
            about = replace(about, home={**about.home, **about.hand.home})
        return about

    def __post_init__(self) -> None:
        if not self.hands:
            hands = tuple(Hand(group.name, (group.name,)) for group in self.groups)
            object.__setattr__(self, "hands", hands)

    @property
    def hand(self) -> Hand:
        """The hand that grasps."""
        return next((h for h in self.hands if h.name == self.hand_name), self.hands[0])

    @property
    def grasping(self) -> tuple[Group, ...]:
        """The groups of the hand that grasps."""
        groups = {group.name: group for group in self.groups}
        return tuple(groups[name] for name in self.hand.groups)

    @property
    def xml(self) -> Path:
        """The first model file."""
        return self.files[0].file

    @property
    def contact_points(self) -> tuple[ContactPoint, ...]:
        """Those of all groups that grasp, group by group."""
        return tuple(point for group in self.grasping for point in group.contact_points)

    def spec(self) -> mujoco.MjSpec:
        """The described model, ready to be composed with others."""
        spec, fixed, units = self._joined()
        if self.carriage:
            self._put_on_carriage(spec)
        self._change(spec, fixed, units)
        return spec

    def _joined(self) -> tuple[mujoco.MjSpec, set[str], dict[str, float]]:
        """The files as one model, the free bases that `lock` fixed in it, and units of angles.

        What 1 in the angles of a joint is [rad], its own file says.
        """
        if not self.files[0].stands_alone:
            raise ModelError(
                f"{self.files[0].file.name} is the first file of {self.name}: pos, quat and prefix "
                "are for those that are joined to it"
            )
        spec, fixed, units = self._part(self.files[0])
        for part in self.files[1:]:
            if not part.prefix:
                raise ModelError(
                    f"{part.file.name} is joined to other files and needs a prefix before its "
                    'names, such as prefix = "hand_"'
                )
            child, more, of_child = self._part(part)
            fixed |= more
            units |= of_child
            body = spec.body(part.at) if part.at else spec.worldbody
            if body is None:
                _known("body", part.at, [b.name for b in spec.bodies], f"at of {part.file.name}")
            frame = body.add_frame(pos=part.pos, quat=part.quat)
            try:
                spec.attach(child, prefix=part.prefix, frame=frame)
            except ValueError as error:
                raise ModelError(f"{part.file.name} cannot be joined: {error}") from error
        return spec, fixed, units

    def _part(self, part: ModelFile) -> tuple[mujoco.MjSpec, set[str], dict[str, float]]:
        """One of the files, without keyframes; and of it what `_joined` has of all."""
        spec, fixed = part.spec(), set()
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        units = {part.prefix + j.name: _angle_unit(spec) for j in spec.joints if j.type != slide}
        self._refuse_ranges(part, spec)
        spec.compiler.conflict = mujoco.mjtConflict.mjCONFLICT_MERGE
        for joint in [j for j in spec.joints if j.type == FREE]:
            name, body = part.prefix + joint.name, joint.parent
            carrier = part.at if body.parent == spec.worldbody else body.parent.name
            if name in self.lock:
                if name in self.bases:
                    _place(spec, body, self.bases[name][:3], self.bases[name][3:])
                for actuator in [a for a in spec.actuators if a.target == joint.name]:
                    spec.delete(actuator)
                for sensor in [s for s in spec.sensors if s.objname == joint.name]:
                    spec.delete(sensor)
                spec.delete(joint)
                fixed.add(name)
            elif carrier:
                raise ModelError(
                    f"{part.file.name} has a free base {name!r}, which {carrier!r} cannot carry: "
                    f'lock = ["{name}"] fixes it'
                )
        # They are read by now, joint by joint; in a larger model they would list others' angles.
        for key in list(spec.keys):
            spec.delete(key)
        return spec, fixed, units

    def _refuse_ranges(self, part: ModelFile, spec: mujoco.MjSpec) -> None:
        """Raise for a range that is reversed, a single angle, or no number."""
        for joint, (low, high) in part.unusable_ranges(spec).items():
            name = part.prefix + joint
            if name not in self.ranges and name not in self.lock:
                right = f"[{high:g}, {low:g}]" if low > high else "[LOW, HIGH]"
                raise ModelError(
                    f"joint {name!r} of {part.file.name} has the range [{low:g}, {high:g}], which "
                    f'MuJoCo would drop: say ranges = {{ "{name}" = {right} }} in rad or m, or '
                    f'lock = ["{name}"]'
                )

    def _put_on_carriage(self, spec: mujoco.MjSpec) -> None:
        """Six joints at the root: at zero the palm is held as a drawn start holds it."""
        palm, roots = self.grasping[0].palm, spec.worldbody.bodies
        if palm is None:
            raise ModelError(f"{self.name}: a carriage needs a palm to hold the hand by")
        if len(roots) != 1 or spec.worldbody.geoms:
            beside = " and geoms of the world" if spec.worldbody.geoms else ""
            raise ModelError(
                f"{self.name}: a carriage carries one root body; the model has "
                f"{', '.join(repr(body.name) for body in roots) or 'none'}{beside}; "
                'root = "BODY" takes that one alone'
            )
        if roots[0].joints:
            joint = roots[0].joints[0]
            free = joint.type == FREE
            mend = f'lock = ["{joint.name}"] fixes it' if free else "give it a body of its own"
            raise ModelError(
                f"{self.name}: a carriage carries a root body without joints; joint "
                f"{joint.name!r} moves {roots[0].name!r}: {mend}"
            )
        alone = replace(self, carriage=False).spec()
        model = compiled_spec(alone, f"{self.xml.name} does not compile")
        data = mujoco.MjData(model)
        for name, angle in self.home.items():
            if name not in CARRIAGE:
                data.joint(name).qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        z = np.array([np.cos(CARRIAGE_PITCH), 0.0, -np.sin(CARRIAGE_PITCH)])
        y = np.array([0.0, 1.0, 0.0])
        R_palm = data.site(palm_site(self.grasping[0])).xmat.reshape(3, 3)
        turn = np.column_stack([y, np.cross(z, y), z]) @ R_palm.T
        root = model.body(roots[0].name).id
        R_root = turn @ data.xmat[root].reshape(3, 3)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, R_root.ravel())
        to_palm = turn @ (data.site(palm_site(self.grasping[0])).xpos - data.xpos[root])
        _place(spec, roots[0], -to_palm, quat)
        axes = np.eye(3)[[0, 1, 2, 2, 1, 0]]
        for name, axis, ends in zip(CARRIAGE, axes, CARRIAGE_RANGES, strict=True):
            slides = name[-2:] in ("_x", "_y", "_z")
            joint = roots[0].add_joint(name=name, axis=R_root.T @ axis, pos=R_root.T @ to_palm)
            joint.type = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
            unit = 1.0 if slides else _angle_unit(spec)
            joint.range, joint.limited = np.array(ends) / unit, mujoco.mjtLimited.mjLIMITED_TRUE

    def _change(self, spec: mujoco.MjSpec, fixed: set[str], units: Mapping[str, float]) -> None:
        """Do to the model what the description asks for; `fixed` bases are so already."""
        joints = {joint.name: joint for joint in spec.joints}
        refs = {name: joint.ref * units.get(name, 1.0) for name, joint in joints.items()}
        for name, ends in self.ranges.items():
            joint = joints[self._joint(name, joints, "ranges")]
            joint.range = np.array(ends) / units.get(name, 1.0)
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        for name in self.drop_couplings if isinstance(self.drop_couplings, tuple) else ():
            known = [n for e in spec.equalities for n in (e.name, e.name1) if n]
            if name not in known:
                raise ModelError(
                    f"drop_couplings of {self.name} names {name!r}; the couplings are: "
                    f"{', '.join(known) or 'none'}"
                )
        for equality in list(spec.equalities):
            if self._drops(equality):
                spec.delete(equality)
        for coupling in self.couplings:
            one = joints[self._joint(coupling.joint, joints, "couplings")]
            other = joints[self._joint(coupling.to, joints, "couplings")]
            rest = coupling.offset + coupling.ratio * refs[other.name] - refs[one.name]
            _couple(spec, one.name, other.name, rest, coupling.ratio)
        for name in self.home:
            self._joint(name, joints, "home")
            if joints[name].type in SIZES:
                raise ModelError(
                    f"home of {self.name}: {name!r} is neither hinge nor slide, which one number "
                    "would place"
                )
        for name in self.lock:
            if name in fixed:
                continue
            joint, unit = joints[self._joint(name, joints, "lock")], units.get(name, 1.0)
            if joint.type in SIZES:
                raise ModelError(
                    f"lock of {self.name}: {name!r} is neither hinge, slide nor free base; leave "
                    "it out of the file"
                )
            low, high = np.array(joint.range) * unit if _limited(spec, joint) else (-INF, INF)
            angle = self.home.get(name, min(max(refs[name], low), high))
            _couple(spec, name, "", angle - refs[name], 0.0)
        for body in spec.bodies:
            for i, geom in enumerate(body.geoms):
                if not geom.name and (geom.contype or geom.conaffinity):
                    geom.name = f"{body.name}:{i}"
        points = self.contact_points
        spheres = {geom.name for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE}
        if not all(p.ball or (p.site and p.geoms and spheres.issuperset(p.geoms)) for p in points):
            spec.option.ccd_tolerance, spec.option.ccd_iterations = CCD_TOLERANCE, CCD_ITERATIONS
        bodies = {body.name: body for body in spec.bodies}
        for group in self.groups:
            palm = group.palm
            if palm is not None and palm.body:
                _known("body", palm.body, bodies, f"palm of {self.name}")
                x, z = _axes(palm)
                quat = np.zeros(4)
                mujoco.mju_mat2Quat(quat, np.column_stack([x, np.cross(z, x), z]).ravel())
                bodies[palm.body].add_site(name=palm_site(group), pos=palm.pos, quat=quat)
        for point in points:
            if point.ball is not None:
                _known("body", point.link, bodies, f"contact point {point.name} of {self.name}")
                bodies[point.link].add_geom(
                    name=ball_name(point),
                    type=mujoco.mjtGeom.mjGEOM_SPHERE,
                    pos=point.ball[:3],
                    size=[point.ball[3], 0.0, 0.0],
                    mass=0.0,
                    material="",  # that of the body's class lacks its prefix in a joined file
                )

    def _drops(self, equality: mujoco.MjsEquality) -> bool:
        if isinstance(self.drop_couplings, bool):
            return self.drop_couplings
        return not {equality.name, equality.name1}.isdisjoint(self.drop_couplings)

    @property
    def equalities(self) -> dict[str, bool]:
        """The files' equalities by name, or joint: whether each stays in force."""
        spec, *_ = self._joined()
        return {e.name or e.name1: not self._drops(e) for e in spec.equalities}

    def _joint(self, name: str, joints: Mapping[str, object], where: str) -> str:
        return _known("joint", name, joints, f"{where} of {self.name}")


def _name(spec: mujoco.MjSpec) -> None:
    """Call bodies and joints without a name after the body that carries them."""
    # Where a file is not UTF-8, reading the names of geoms and sites says so, here and not later.
    named = {thing.name for thing in (*spec.bodies, *spec.joints, *spec.geoms, *spec.sites)}

    def new(stem: str, things: Sequence[Any]) -> None:
        for i, thing in enumerate(things):
            if not thing.name:
                name = stem if len(things) == 1 else f"{stem}_{i + 1}"
                while name in named:
                    name += "_"
                thing.name = name
                named.add(name)

    for body in spec.bodies:  # those that carry come first
        new(f"{body.name}_joint", body.joints)
        new(f"{body.name}_body", body.bodies)


def _place(
    spec: mujoco.MjSpec,
    root: mujoco.MjsBody,
    pos: Sequence[float] | np.ndarray,
    quat: Sequence[float] | np.ndarray,
) -> None:
    """Put a root body at `pos` (3,) [m] and `quat`, world, whatever the file places it by."""
    root.pos, root.quat = pos, quat
    root.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT  # else Euler angles go first
    if root.frame is not None:
        root.set_frame(spec.worldbody.add_frame())


def _limited(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> bool:
    """Whether MuJoCo will keep the joint within its range."""
    if joint.limited == mujoco.mjtLimited.mjLIMITED_AUTO:
        return bool(spec.compiler.autolimits and joint.range[0] < joint.range[1])
    return bool(joint.limited == mujoco.mjtLimited.mjLIMITED_TRUE)


def _angle_unit(spec: mujoco.MjSpec) -> float:
    """What 1 in the angles of a model file is [rad]."""
    return float(np.pi / 180.0) if spec.compiler.degree else 1.0


def palm_site(group: Group) -> str:
    """The site of a group's palm in the described model."""
    palm = group.palm
    return palm.site if palm is not None and palm.site else f"palm of {group.name}"


def ball_name(point: ContactPoint) -> str:
    """The geom that stands for a contact point with a ball."""
    return f"ball of {point.name}"


def _find(robot: str | Path) -> Path:
    """The robot.toml of a robot by name, folder or file."""
    if isinstance(robot, str | Path) and Path(robot).suffix.lower() in MODELS:
        raise ModelError(
            f"{robot} is a model, and a robot is a description of one: hqp-grasp robot {robot} "
            "writes a first one beside it"
        )
    if isinstance(robot, Path) or "/" in str(robot) or str(robot).endswith(".toml"):
        path = Path(robot)
        if path.suffix == ".toml":
            if not path.is_file():
                raise ModelError(f"there is no file {path}")
            return path
        if not (path / "robot.toml").is_file():
            raise ModelError(f"{path} is no robot folder: it has no robot.toml")
        return path / "robot.toml"
    root = Path(str(resources.files("hqp_grasp.robots")))
    known = sorted(p.parent.name for p in root.glob("*/*.toml"))
    return root / one_of("robot", robot, known) / "robot.toml"


def locate(text: str, folder: Path) -> Path:
    """A file by its path, or as `package:path` in an installed package, which is not imported.

    The path begins in the package's own folder, or is how the path of one of the installed files
    ends.
    """
    package, _, inside = text.partition(":")
    if not _package(text):
        return folder / text
    _refuse_missing([text])
    for place in _places(package):
        if (place / inside).exists():
            return place / inside
    try:
        installed = metadata.files(package) or []
    except metadata.PackageNotFoundError:
        installed = []
    found = sorted({str(f.locate()) for f in installed if f"/{f}".endswith(f"/{inside}")})
    if len(found) != 1:
        what = f"{len(found)} files end so: {', '.join(found[:3])}" if found else "no such file"
        raise ModelError(f"{text}: {what} in the installed package {package!r}")
    return Path(found[0])


def _package(text: str) -> str:
    """The package of a `package:path`; "" for a path."""
    package, colon, _ = text.partition(":")
    return package if colon and "/" not in package else ""


def _places(package: str) -> list[Path]:
    """The folders of an importable package, none where there is none."""
    spec = find_spec(package) if package.isidentifier() else None
    return [Path(place) for place in (spec.submodule_search_locations or ())] if spec else []


def _refuse_missing(files: Sequence[str]) -> None:
    """Raise, with the line that installs them, for all packages of these that are not there."""
    missing: dict[str, str] = {}
    for text in files:
        package = _package(text)
        if package and not _places(package):
            try:
                metadata.distribution(package)
            except metadata.PackageNotFoundError:
                missing.setdefault(package, text)
    if missing:
        names = ", ".join(map(repr, missing))
        what = "packages {} are" if len(missing) > 1 else "package {} is"
        raise ModelError(
            f"{next(iter(missing.values()))}: the {what.format(names)} not installed; "
            f"pip install --no-deps {' '.join(missing)} is enough"
        )


def _description(path: Path, data: Mapping[str, Any]) -> RobotDescription:
    _check(data, TOP)
    folder = path.parent
    model = data["model"]
    parts = model if isinstance(model, list) else [model]
    if not parts:
        raise InputError("model is empty")
    if "root" in data:
        if not isinstance(model, str):
            raise InputError("root belongs into [[model]], beside the file whose body it names")
        parts = [{"file": model, "root": data["root"]}]
    if isinstance(data.get("hands"), list):
        raise InputError("hands names groups, hands = { both = [...] }; a group is [[groups]]")
    if "groups" in data:
        mixed = [key for key in KEYS["group"] if key in data]
        if mixed:
            raise InputError(f"{mixed[0]} belongs into [[groups]], as there are groups")
        groups = tuple(_group(group) for group in data["groups"])
    else:
        own = {key: data[key] for key in KEYS["group"] if key in data}
        groups = (_group({"name": "hand", **own}),)
    if not groups:
        raise InputError("groups is empty")
    _refuse_twice("groups", [group.name for group in groups])
    hands = _hands(groups, _table("hands", data, "hands"))
    told = (part.get("file") if isinstance(part, dict) else part for part in parts)
    _refuse_missing([text for text in told if isinstance(text, str)])
    files = tuple(_file(part, folder) for part in parts)
    named, bases = data.get("home"), dict[str, tuple[float, ...]]()
    if named is None or isinstance(named, str):
        home, bases = _keyframe(folder, files, named)
    else:
        home = {j: _number(f"home of {j}", v) for j, v in _table("home", data).items()}
    # Couplings that are said replace the file's, all or those that drop_couplings names.
    drop = data.get("drop_couplings", "couplings" in data)
    workspace = data.get("workspace")
    return RobotDescription(
        name=folder.resolve().name if path.name == "robot.toml" else path.stem,
        files=files,
        groups=groups,
        hands=hands,
        home=home,
        bases=bases,
        speed=positive("speed", data["speed"]) if "speed" in data else None,
        velocity={j: positive(f"velocity of {j}", v) for j, v in _table("velocity", data).items()},
        lock=_texts(data.get("lock", [])),
        couplings=tuple(_coupling(c) for c in data.get("couplings", [])),
        drop_couplings=drop if isinstance(drop, bool) else _texts(drop),
        ranges={j: _joint_range(j, v) for j, v in _table("ranges", data).items()},
        carriage=_flag("carriage", data.get("carriage", False)),
        workspace=None if workspace is None else _vector("workspace", workspace),
        clearance=_clearance(data.get("clearance", CLEARANCE)),
        start=_start(data.get("start", {})),
    )


def _keyframe(
    folder: Path, files: tuple[ModelFile, ...], name: str | None
) -> tuple[dict[str, float], dict[str, tuple[float, ...]]]:
    """Angles [rad, m] and free bases in the keyframe of that name, without a name in "home".

    Each file's keyframe says where its own joints are.
    """
    read = [part.keyframes() for part in files]
    known = [key for keys in read for key in keys if key]
    if name is not None and name not in known:
        raise ModelError(
            f"no keyframe {name!r} in {', '.join(p.file.name for p in files)} of "
            f"{folder.resolve().name}; keyframes are: {', '.join(dict.fromkeys(known)) or 'none'}"
        )
    found = [item for keys in read for item in keys.get(name or "home", {}).items()]
    angles = {joint: at[0] for joint, at in found if len(at) == 1}
    return angles, {joint: at for joint, at in found if len(at) == SIZES[FREE]}


def _file(part: object, folder: Path) -> ModelFile:
    if isinstance(part, str):
        return ModelFile(locate(part, folder))
    if not isinstance(part, dict):
        raise InputError(f"model must be a file, or tables that say more; got {part!r}")
    _check(part, KEYS["file"], "model")
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    if "quat" in part:
        quat = np.array(as_array("quat", part["quat"], (4,)))
        positive("length of quat", np.linalg.norm(quat))
        quat = quat / np.linalg.norm(quat)
    elif "rpy" in part:
        mujoco.mju_euler2Quat(quat, as_array("rpy", part["rpy"], (3,)), "XYZ")
    flags = ("degrees", "balanceinertia", "fusestatic")
    return ModelFile(
        locate(_text(part["file"]), folder),
        _text(part.get("prefix", "")),
        _text(part.get("at", "")),
        _vector("pos", part.get("pos", [0.0] * 3)),
        tuple(quat.tolist()),
        **{flag: _flag(flag, part[flag]) for flag in flags if flag in part},
        package_root=folder / _text(part["package_root"]) if "package_root" in part else None,
        root=_text(part.get("root", "")),
    )


def _refuse_twice(what: str, names: list[str]) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"two {what} are named {twice!r}")


def _group(data: object) -> Group:
    if not isinstance(data, dict):
        raise InputError(f"groups must be tables; got {data!r}")
    _check(data, KEYS["group"], "groups")
    name = _text(data["name"])
    points = tuple(_contact_point(p) for p in data["contact_points"])
    if not points:
        raise InputError(f"contact_points of {name} is empty: a group touches with one at least")
    return Group(
        name,
        points,
        _palm(data["palm"]) if "palm" in data else None,
        _texts(data["arm"]) if "arm" in data else None,
        _text(data["adduction"]) if "adduction" in data else None,
    )


def _hands(groups: Sequence[Group], table: Mapping[str, object]) -> tuple[Hand, ...]:
    """Each group by itself, and the hands of several that the table adds."""
    by_name = {group.name: group for group in groups}
    hands = [Hand(name, (name,)) for name in by_name]
    for name, value in table.items():
        about: Any = value if isinstance(value, dict) else {"groups": value}
        _check(about, KEYS["hand"], f"hands.{name}")
        together = tuple(
            _known("group", group, by_name, f"hands.{name}") for group in _texts(about["groups"])
        )
        if not together:
            raise InputError(f"hands.{name} is empty: it names the groups that grasp together")
        _refuse_twice(f"groups of hands.{name}", list(together))
        own = _table("home", about)
        home = {j: _number(f"home of {j} in hands.{name}", v) for j, v in own.items()}
        hands.append(Hand(name, together, home, _start(about.get("start", {}))))
    _refuse_twice("hands", [hand.name for hand in hands])
    for hand in hands:
        points = [point for name in hand.groups for point in by_name[name].contact_points]
        _refuse_twice(f"contact points of hand {hand.name!r}", [point.name for point in points])
    return tuple(hands)


def _palm(data: object) -> Palm:
    if not isinstance(data, dict):
        return Palm(_text(data))
    _check(data, KEYS["palm"], "palm")
    vectors = ("pos", "approach", "opposition")
    given = {key: _vector(f"palm.{key}", data[key]) for key in vectors if key in data}
    palm = Palm("", _text(data["body"]), **given)
    _axes(palm)
    return palm


def _axes(palm: Palm) -> tuple[np.ndarray, np.ndarray]:
    """Opposition axis x and approach axis z, unit and orthogonal; x gives way."""
    z, x = np.array(palm.approach), np.array(palm.opposition)
    z = z / positive("length of palm.approach", np.linalg.norm(z))
    x = x - (x @ z) * z
    if np.linalg.norm(x) < 1e-6:
        raise InputError("palm.opposition is along palm.approach")
    return x / np.linalg.norm(x), z


def _contact_point(data: object) -> ContactPoint:
    if not isinstance(data, dict):
        raise InputError(
            f'contact_points must be tables, such as {{ link = "BODY" }}; got {data!r}'
        )
    _check(data, KEYS["contact point"], "contact_points")
    ball = data.get("ball")
    if ball is not None:
        _check(ball, KEYS["ball"], "ball")
        centre = _vector("ball.pos", ball.get("pos", [0.0] * 3))
        ball = (*centre, positive("ball.radius", ball["radius"]))
    flexion = data.get("flexion")
    by_arm = flexion == "arm"
    if by_arm:
        closing: Mapping[str, float] | None = {}
    elif isinstance(flexion, dict):
        closing = {
            joint: _number(f"flexion of {joint}", weight) for joint, weight in flexion.items()
        }
    elif isinstance(flexion, str):
        raise InputError(
            f'flexion must be "arm", a list of joints, or {{ JOINT = weight }}; got {flexion!r}'
        )
    else:
        closing = None if flexion is None else dict.fromkeys(_texts(flexion), 1.0)
    geoms = (_text(data["geom"]),) if "geom" in data else _texts(data.get("geoms", []))
    link = _text(data.get("link", ""))
    if not link and not geoms:
        raise KeyError("link")
    return ContactPoint(
        _text(data.get("name", link or geoms[0])),
        link,
        geoms,
        _text(data.get("site", "")),
        ball,
        closing,
        by_arm,
        _text(data.get("force", "")),
        _text(data.get("torque", "")),
    )


def _coupling(data: object) -> Coupling:
    if not isinstance(data, dict):
        raise InputError(f"couplings must be tables; got {data!r}")
    _check(data, KEYS["coupling"], "couplings")
    ratio, offset = (
        _number(f"couplings.{k}", data.get(k, default))
        for k, default in (("ratio", 1.0), ("offset", 0.0))
    )
    return Coupling(_text(data["joint"]), _text(data["to"]), ratio, offset)


def _start(data: object) -> Mapping[str, Any]:
    """Fields of a Start: angles in degrees here, radians there."""
    if not isinstance(data, dict):
        raise InputError(f"start must be a table; got {data!r}")
    _check(data, KEYS["start"], "start")
    start: dict[str, Any] = {}
    for key, value in data.items():
        if key in ("advance", "joints"):
            start[key] = _number(f"start.{key}", value)
        elif key == "lean":
            start[key] = np.radians(_number("start.lean", value))
        else:
            low, high = _range(f"start.{key}", value)
            turn = 1.0 if key == "offset" else np.pi / 180.0
            start[key] = (low * turn, high * turn)
    return start


def _couple(spec: mujoco.MjSpec, joint: str, to: str, rest: float, ratio: float) -> None:
    equality = spec.add_equality(name1=joint, name2=to, type=mujoco.mjtEq.mjEQ_JOINT)
    equality.data[:5] = [rest, ratio, 0.0, 0.0, 0.0]


def nearest(name: str, known: object) -> str:
    """The hint that names the nearest valid name, or all of them."""
    names = [n for n in map(str, known) if n]  # type: ignore[call-overload]
    near = difflib.get_close_matches(name, names)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"{hint}they are: {', '.join(names) or 'none'}"


def _known(kind: str, name: str, known: object, where: str) -> str:
    if name not in known:  # type: ignore[operator]
        raise ModelError(f"{where}: no {kind} {name!r}; {nearest(name, known)}")
    return name


def _check(data: object, valid: tuple[str, ...], where: str = "") -> None:
    """Raise for an entry that is not known, which would be ignored otherwise."""
    if not isinstance(data, Mapping):
        raise InputError(f"{where or 'a description'} must be a table; got {data!r}")
    for key in data:
        if key not in valid:
            near = difflib.get_close_matches(key, valid)
            hint = f"did you mean {near[0]!r}? Entries" if near else "entries"
            raise ModelError(f"unknown entry {key!r}; {hint} are: {', '.join(valid)}")


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise InputError(f"{value!r} is no name")
    return value


def _texts(value: object) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise InputError(f"{value!r} is no list of names")
    return tuple(_text(v) for v in value)


def _table(name: str, data: Mapping[str, Any], of: str = "joints") -> Mapping[str, object]:
    table = data.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"{name} must be a table of {of}; got {table!r}")
    return table


def _flag(name: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{name} must be true or false; got {value!r}")
    return value


def _vector(name: str, value: object) -> tuple[float, ...]:
    return tuple(as_array(name, value, (3,)).tolist())


def _range(name: str, value: object) -> tuple[float, float]:
    low, high = as_array(name, value, (2,)).tolist()
    if not low <= high:
        raise InputError(f"{name} must be [low, high]; got {value!r}")
    return low, high


def _joint_range(joint: str, value: object) -> tuple[float, float]:
    low, high = _range(f"ranges of {joint}", value)
    if low == high:
        raise InputError(
            f'ranges of {joint} must be [low, high], low < high; lock = ["{joint}"] holds it at '
            f"home, home = {{ {joint} = {low:g} }} puts it there"
        )
    return low, high


def _number(name: str, value: object) -> float:
    """A finite number, as TOML writes it."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} must be a finite number; got {value!r}")
    return float(value)


def _clearance(value: object) -> float:
    clearance = _number("clearance", value)
    if clearance < 0.0:
        raise InputError(f"clearance must be 0 or more [m]; got {value!r}")
    return clearance
