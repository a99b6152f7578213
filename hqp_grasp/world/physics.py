"""A scene in full dynamics: servos that drive the robot, and an object that yields and weighs."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np

from hqp_grasp.errors import InputError, ModelError, one_of, positive
from hqp_grasp.world.compiling import compiled_spec
from hqp_grasp.world.imperfections import Imperfections
from hqp_grasp.world.objects import OBJECT
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

# How a contact yields: solref and solimp of the object's geom.
CONTACTS = {
    "stiff": ((0.005, 1.0), (0.99, 0.999, 0.001, 0.5, 2.0)),
    "medium": ((0.01, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)),
    "default": ((0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)),  # MuJoCo's
}
SUPPORTS = ("fixed", "pedestal", "table")
SUPPORT = "support"  # the geom that a free object stands on
# Iterations of MuJoCo's solver without slip, for what is held: with none it creeps by 0.5 mm/s. But
# what only stands shakes on its support with them: a touched one moves four times as far.
# With two, an object that leaves its support was thrown out of the hand, once in 100 times.
NOSLIP = 10
# By MuJoCo's own tolerance, 1e-8, its solver ends early now and then while a hand grips, and all
# contact forces vanish for a step: with this one that was not seen.
SOLVED = 1e-10
SPIN_FRICTION = 0.02  # [m] torque about the normal that a contact transmits, by normal force


@dataclass(frozen=True)
class Physics:
    """The world in which a simulated hand touches.

    `contact` says how the object yields, one of CONTACTS. `support` holds it: "fixed"; free on a
    "pedestal" narrower than itself; free on a "table".
    """

    contact: str = "medium"
    support: str = "fixed"
    mass: float = 0.1  # [kg] of a free object
    friction: float = 0.6  # of the object
    timestep: float = 0.002  # [s]
    imperfections: Imperfections = field(default_factory=Imperfections)

    def __post_init__(self) -> None:
        one_of("contact", self.contact, CONTACTS)
        one_of("support", self.support, SUPPORTS)
        for name in ("mass", "friction", "timestep"):
            object.__setattr__(self, name, positive(f"Physics.{name}", getattr(self, name)))
        if not isinstance(self.imperfections, Imperfections):
            raise InputError(
                "Physics.imperfections must be Imperfections, such as "
                f'Imperfections.preset("loadcell"); got {self.imperfections!r}'
            )


def simulated_model(
    scene: Scene, physics: Physics, links: str = "block", feeling: bool = True
) -> mujoco.MjModel:
    """Robot, object and what it stands on, with servos, and sensors at the tips if `feeling`.

    With links="pass" only tips meet the object. A free object's joint bears its name, OBJECT; what
    it stands on is the geom SUPPORT. Force and torque of tip p are the sensors "p touch force" and
    "p touch torque", minus what the world applies to it; an independent joint's torque is
    "joint torque". Idle joints are fixed at home. Who holds the object sets
    `opt.noslip_iterations` to NOSLIP meanwhile. Raises InputError where tips cannot feel.
    """
    spec, robot = scene.spec(), scene.articulated
    tips = round_tips(robot) if feeling or links == "pass" else []
    _set_options(spec, physics)
    _compensate(spec, 1.0 + physics.imperfections.gravity_error)
    _make_yield(spec.body(OBJECT), physics)
    if physics.support != "fixed":
        _set_down(spec, scene, physics.support)
    if links == "pass":
        _let_pass(spec, robot, tips)
    if feeling:
        _add_tip_sensors(spec, robot)
    _brake(spec, robot)
    _add_torque_sensors(spec, np.array(robot.joints)[~robot.idle].tolist())
    if physics.support != "fixed":
        _add_palm_sensors(spec, robot)
    model = compiled_spec(spec, f"{robot.description.xml.name} does not compile")
    if physics.support != "fixed":
        _weigh(model, physics.mass)
    return model


def palm_sensors(model: mujoco.MjModel) -> slice:
    """Where the sensors say how a free object stands in the palm's frame: (7,) [m, quaternion]."""
    first = int(model.sensor(f"{OBJECT} position").adr[0])
    return slice(first, first + 7)


def servos(model: mujoco.MjModel, joints: tuple[str, ...]) -> np.ndarray:
    """The position actuator (n,) of each joint."""
    found = []
    for name in joints:
        drives = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)) & (
            model.actuator_trnid[:, 0] == model.joint(name).id
        )
        affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
        (servo,) = np.nonzero(drives & affine & (model.actuator_forcelimited != 0))
        if len(servo) != 1:
            raise ModelError(
                f"joint {name!r} needs one position actuator with a forcerange; it has {len(servo)}"
            )
        found.append(int(servo[0]))
    return np.array(found)


def round_tips(robot: Robot) -> list[str]:
    """The geom of each tip, by name. Raises InputError where one cannot feel."""
    for point, radius in zip(robot.description.contact_points, robot.tip_radius, strict=True):
        if radius == 0.0 or not point.site:
            raise InputError(
                f"the simulated hand feels with round tips that have a site at their centre; "
                f"{point.name} of {robot.description.name} has none; an MJCF can have them, and "
                "servos. A URDF cannot: it is probed geometrically"
            )
    return [robot.model.geom(geoms[0]).name for geoms in robot.geoms]


def foot(scene: Scene) -> tuple[float, float]:
    """Height of the object's lowest point [m], and half its narrowest horizontal width [m]."""
    model, robot = scene.model, scene.articulated
    data = mujoco.MjData(model)
    robot.place(data, robot.home)
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for geom in np.flatnonzero(model.geom_bodyid == model.body(OBJECT).id):
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            R = data.geom_xmat[geom].reshape(3, 3)
            center, reach = data.geom_xpos[geom] + R @ middle, np.abs(R) @ half
            lower, upper = np.minimum(lower, center - reach), np.maximum(upper, center + reach)
    return float(lower[2]), float((upper - lower)[:2].min() / 2.0)


def _set_options(spec: mujoco.MjSpec, physics: Physics) -> None:
    spec.option.timestep = physics.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.tolerance = SOLVED


def _compensate(spec: mujoco.MjSpec, share: float) -> None:
    """Carry that share of every link's weight."""
    for body in spec.bodies:
        if body.name not in ("world", OBJECT):
            body.gravcomp = share


def _make_yield(thing: mujoco.MjsBody, physics: Physics) -> None:
    for geom in thing.geoms:
        # The object decides how a contact is: else its friction would be the larger of both geoms'.
        geom.priority, geom.condim = 1, 4
        geom.solref, geom.solimp = CONTACTS[physics.contact]
        geom.friction = (physics.friction, SPIN_FRICTION, 1e-4)
        if not (geom.contype or geom.conaffinity):
            geom.mass = 0.0  # drawn, not felt


def _set_down(spec: mujoco.MjSpec, scene: Scene, support: str) -> None:
    """Free the object, and put a support below it."""
    spec.body(OBJECT).add_freejoint(name=OBJECT)
    bottom, width = foot(scene)
    if support == "pedestal":
        half = max(0.02, bottom / 2.0)
        size, kind = [0.5 * width, half, 0.0], mujoco.mjtGeom.mjGEOM_CYLINDER
    else:
        half, kind = 0.02, mujoco.mjtGeom.mjGEOM_BOX
        size = [0.3, 0.3, half]
    x, y = np.array(scene.position)[:2]
    spec.worldbody.add_geom(name=SUPPORT, type=kind, size=size, pos=[x, y, bottom - half])


def _weigh(model: mujoco.MjModel, mass: float) -> None:
    """Give the object that mass [kg], spread as it is."""
    body = model.body(OBJECT).id
    share = mass / model.body_mass[body]
    model.body_mass[body] *= share
    model.body_inertia[body] *= share
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _let_pass(spec: mujoco.MjSpec, robot: Robot, tips: list[str]) -> None:
    """Let all links but the tips pass through the object."""
    touching = {robot.model.geom(name).bodyid[0] for name in tips}
    for body in spec.bodies:
        if body.name in ("world", OBJECT) or robot.model.body(body.name).id in touching:
            continue
        spec.add_exclude(bodyname1=body.name, bodyname2=OBJECT)


def _add_tip_sensors(spec: mujoco.MjSpec, robot: Robot) -> None:
    for point in robot.description.contact_points:
        for kind, word in (
            (mujoco.mjtSensor.mjSENS_FORCE, "force"),
            (mujoco.mjtSensor.mjSENS_TORQUE, "torque"),
        ):
            spec.add_sensor(
                name=f"{point.name} touch {word}",
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=point.site,
            )


def _add_torque_sensors(spec: mujoco.MjSpec, joints: list[str]) -> None:
    for joint in joints:
        spec.add_sensor(
            name=f"{joint} torque",
            type=mujoco.mjtSensor.mjSENS_JOINTACTFRC,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )


def _add_palm_sensors(spec: mujoco.MjSpec, robot: Robot) -> None:
    for kind, word in (
        (mujoco.mjtSensor.mjSENS_FRAMEPOS, "position"),
        (mujoco.mjtSensor.mjSENS_FRAMEQUAT, "orientation"),
    ):
        spec.add_sensor(
            name=f"{OBJECT} {word}",
            type=kind,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=OBJECT,
            reftype=mujoco.mjtObj.mjOBJ_XBODY,
            refname=robot.model.body(robot.groups[0].palm_body).name,
        )


def _brake(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Fix at home the joints that move no contact point, as those of another arm."""
    if not robot.idle.any():
        return
    model, data = robot.model, mujoco.MjData(robot.model)
    robot.place(data, robot.home)
    fixed = np.flatnonzero(~robot.coupling[:, ~robot.idle].any(axis=1))
    names = {model.joint(j).name for j in fixed.tolist()}
    for link in spec.bodies:
        joints = [joint for joint in link.joints if joint.name in names]
        if not joints:
            continue
        body = model.body(link.name).id
        parent = int(model.body_parentid[body])
        back, away = np.zeros(4), data.xpos[body] - data.xpos[parent]
        mujoco.mju_negQuat(back, data.xquat[parent])
        mujoco.mju_rotVecQuat(link.pos, away, back)
        mujoco.mju_mulQuat(link.quat, back, data.xquat[body])
        link.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        for joint in joints:
            spec.delete(joint)
    for equality in list(spec.equalities):
        if {equality.name1, equality.name2} & names:
            spec.delete(equality)
    for actuator in list(spec.actuators):
        if actuator.target in names:
            spec.delete(actuator)
