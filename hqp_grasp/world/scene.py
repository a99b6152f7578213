"""The world of a grasp: one robot and one upright object in one MuJoCo model."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args, get_type_hints

import mujoco
import numpy as np

from hqp_grasp.errors import HqpGraspError, InputError, ResultsError
from hqp_grasp.files import whole_file
from hqp_grasp.grasp import as_array
from hqp_grasp.world.compiling import compiled_spec
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.objects import OBJECT, Body, Cylinder, Prism
from hqp_grasp.world.robot import Robot, compiled, described

CAN = Cylinder(radius=0.05)  # the paper's first object


class _Name(str):
    """A robot's name, which says where the robot is when it is taken for it."""

    def __getattr__(self, name: str) -> object:
        raise AttributeError(
            f"Scene.robot is the name that the scene was given, {str(self)!r}, and has no "
            f"{name!r}; the robot is scene.articulated"
        )


@dataclass(frozen=True)
class Scene:
    """A robot and an object that stands still, its middle at `position`.

    `robot` stays what was given, a name or a path; the robot itself is `articulated`. An object
    given by the path of a file is the Body of that file.

    Without a position it stands in the robot's workspace, and the robot's first hand grasps it.
    `base` moves the robot away from where its model puts it: a hand without an arm is placed so.
    """

    robot: str | Path = "wam_bhand"
    object: Cylinder | Prism | Body = CAN
    position: tuple[float, float, float] | None = None  # [m] world
    base: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # [m], unit quaternion w x y z
    hand: str | None = None  # of a robot with several

    def __post_init__(self) -> None:
        if isinstance(self.robot, str):
            object.__setattr__(self, "robot", _Name(self.robot))
        if isinstance(self.object, Path) or (
            isinstance(self.object, str) and Path(self.object).suffix
        ):
            object.__setattr__(self, "object", Body(self.object))
        if not isinstance(self.object, Cylinder | Prism | Body):
            raise InputError(
                f"unknown object {self.object!r}; choose one of: Cylinder, Prism, Body, or the "
                "path of a file"
            )
        description = described(self.robot, self.hand)
        object.__setattr__(self, "_description", description)
        if self.position is None:
            workspace = description.workspace
            if workspace is None:
                workspace = Robot(description, compiled(description)).workspace
            object.__setattr__(self, "position", workspace)
        try:
            position = as_array("Scene.position", self.position, (3,))
        except InputError as error:
            raise InputError(
                f"Scene.position must be 3 finite numbers; got {self.position!r}"
            ) from error
        object.__setattr__(self, "position", tuple(position.tolist()))
        base = as_array("Scene.base", self.base, (7,))
        if abs(np.linalg.norm(base[3:]) - 1.0) > 1e-9:
            raise InputError(f"Scene.base needs a unit quaternion (w, x, y, z); got {base[3:]}")
        object.__setattr__(self, "base", tuple(base.tolist()))

    def spec(self) -> mujoco.MjSpec:
        """Robot and object, to be changed before they are compiled."""
        description: RobotDescription = self.__dict__["_description"]
        spec = description.spec()
        try:
            world = spec.worldbody
            # What stands in a frame of its file keeps its place in it.
            loose = [
                thing
                for thing in (*world.bodies, *world.frames, *world.geoms, *world.sites)
                if thing.frame is None
            ]
            frame = world.add_frame(pos=self.base[:3], quat=self.base[3:])
            for thing in loose:
                thing.set_frame(frame)
            body = spec.worldbody.add_body(name=OBJECT, pos=self.position)
            self.object.add_geoms(spec, body)
        except ValueError as error:
            raise InputError(f"{description.xml.name} does not compile: {error}") from error
        return spec

    @cached_property
    def model(self) -> mujoco.MjModel:
        """Robot and object, compiled."""
        name = self.__dict__["_description"].xml.name
        return compiled_spec(self.spec(), f"{name} does not compile")

    @cached_property
    def articulated(self) -> Robot:
        """The robot as it stands in this scene's model."""
        return Robot(self.__dict__["_description"], self.model)

    def rebased(self, p: np.ndarray, R: np.ndarray) -> Scene:
        """The same scene, the robot's base moved by x ↦ R x + p, world."""
        turn, quaternion = np.zeros(4), np.zeros(4)
        mujoco.mju_mat2Quat(turn, np.ravel(R))
        mujoco.mju_mulQuat(quaternion, turn, np.array(self.base[3:]))
        quaternion /= np.linalg.norm(quaternion)
        return replace(self, base=(*(R @ np.array(self.base[:3]) + p), *quaternion))

    def save(self, path: str | Path) -> None:
        """Write what `load` needs as JSON: robot by name or folder, object, and their places."""
        robot = self.robot
        if isinstance(robot, Path) or "/" in robot:
            robot = str(Path(robot).resolve())
        given = {f.name: getattr(self.object, f.name) for f in fields(self.object) if f.init}
        thing = {"kind": type(self.object).__name__} | given
        data = {"robot": robot, "object": thing, "position": self.position, "base": self.base}
        data |= {} if self.hand is None else {"hand": self.hand}
        with whole_file(path) as part:
            part.write_text(json.dumps(data, indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """The scene that `save` wrote. Raises ResultsError for a file that holds none."""
        kinds = {kind.__name__: kind for kind in get_args(get_type_hints(cls)["object"])}
        try:
            data = json.loads(Path(path).read_text())
            thing = dict(data["object"])
            thing = kinds[thing.pop("kind")](**thing)
            return cls(data["robot"], thing, data["position"], data["base"], data.get("hand"))
        except (OSError, ValueError, KeyError, TypeError, HqpGraspError) as error:
            raise ResultsError(f"{path} holds no scene: {error}") from error

    def __getstate__(self) -> dict[str, Any]:
        # Compiled models stay in their process; the value is what travels.
        return {
            name: getattr(self, name) for name in ("robot", "object", "position", "base", "hand")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()
