"""Grasping by touch, with control laws in strict order and within a robot's limits."""

import difflib
from importlib.metadata import version
from typing import TYPE_CHECKING

from hqp_grasp.control.controller import Controller, Step
from hqp_grasp.control.forces import GRIP_LAWS, Felt, ForceLaw, Forces, Grip, Squeeze
from hqp_grasp.control.forms import (
    ClippedForm,
    Form,
    HierarchyForm,
    MemorylessForm,
    PaperForm,
    form_of,
)
from hqp_grasp.control.hold import Hold, Press
from hqp_grasp.control.ik import ik_levels, solve_ik
from hqp_grasp.control.limits import ClearanceLimit, ConfigurationLimit, StepLimit, VelocityLimit
from hqp_grasp.errors import (
    HqpGraspError,
    InputError,
    MissingExtraError,
    ModelError,
    ReachError,
    ResultsError,
    SingularTaskError,
    SolverError,
    TrialError,
    WorkerError,
)
from hqp_grasp.experiments.lifting import Lift, lift
from hqp_grasp.experiments.pick import Pick, Picked
from hqp_grasp.experiments.record import Record
from hqp_grasp.experiments.start import Start
from hqp_grasp.experiments.study import Study
from hqp_grasp.experiments.trial import Trial
from hqp_grasp.grasp import Contact, Frame, Grasp, Miss, Missed, Touch
from hqp_grasp.hierarchy.hqp import HQP, solvers
from hqp_grasp.hierarchy.level import Level, LevelReport, Solution
from hqp_grasp.hierarchy.projection import Projection
from hqp_grasp.history import load_history, save_history
from hqp_grasp.judge.judge import Judge, Judged
from hqp_grasp.tasks import (
    AlignTask,
    ContactSpaceTask,
    ContactTask,
    ForceTask,
    KinematicTask,
    Limit,
    MinkLimit,
    MinkTask,
    MomentTask,
    PostureTask,
    Priority,
    Stack,
    Task,
    stack_of,
)
from hqp_grasp.touch.driver import Driver, DriverLimits, Readings
from hqp_grasp.touch.driver_contract import DriverError, Rig, check_driver
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.touch.noisy import Noise, NoisyProbe
from hqp_grasp.touch.physical import PhysicalProbe
from hqp_grasp.touch.probe import Probe
from hqp_grasp.touch.sensing import sense
from hqp_grasp.touch.simulated import SimulatedHand
from hqp_grasp.world.description import RobotDescription
from hqp_grasp.world.imperfections import Imperfections
from hqp_grasp.world.objects import Body, Cylinder, Prism
from hqp_grasp.world.physics import Physics
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

__version__ = version("hqp_grasp")

__all__ = [
    "GRIP_LAWS",
    "HQP",
    "AlignTask",
    "Body",
    "ClearanceLimit",
    "ClippedForm",
    "ConfigurationLimit",
    "Contact",
    "ContactSpaceTask",
    "ContactTask",
    "Controller",
    "Cylinder",
    "Driver",
    "DriverError",
    "DriverLimits",
    "Felt",
    "ForceLaw",
    "ForceTask",
    "Forces",
    "Form",
    "Frame",
    "GeometricProbe",
    "Grasp",
    "Grip",
    "HierarchyForm",
    "Hold",
    "HqpGraspError",
    "Imperfections",
    "InputError",
    "Judge",
    "Judged",
    "KinematicTask",
    "Level",
    "LevelReport",
    "Lift",
    "Limit",
    "MemorylessForm",
    "MinkLimit",
    "MinkTask",
    "Miss",
    "Missed",
    "MissingExtraError",
    "ModelError",
    "MomentTask",
    "Noise",
    "NoisyProbe",
    "PaperForm",
    "PhysicalProbe",
    "Physics",
    "Pick",
    "Picked",
    "PostureTask",
    "Press",
    "Priority",
    "Prism",
    "Probe",
    "Projection",
    "ReachError",
    "Readings",
    "Record",
    "ResultsError",
    "Rig",
    "Robot",
    "RobotDescription",
    "Scene",
    "SimulatedHand",
    "SingularTaskError",
    "Solution",
    "SolverError",
    "Squeeze",
    "Stack",
    "Start",
    "Step",
    "StepLimit",
    "Study",
    "Task",
    "Touch",
    "Trial",
    "TrialError",
    "VelocityLimit",
    "WorkerError",
    "check_driver",
    "form_of",
    "ik_levels",
    "lift",
    "load_history",
    "save_history",
    "sense",
    "solve_ik",
    "solvers",
    "stack_of",
]

# What other libraries call it, or what one would expect here: where it is.
_ELSEWHERE = {
    "Configuration": "nothing here holds a posture: hg.Scene(…).articulated is the robot, and its "
    "centers(q), jacobian(q), palm(q) take it; mink's IK by strict levels is hg.solve_ik",
    "CollisionAvoidanceLimit": "hg.ClearanceLimit(robot) keeps a robot's own links apart, and is "
    "there unless its description says clearance = 0; mink's goes into a stack as it is: "
    "stack.within(mink.CollisionAvoidanceLimit(…))",
    "Box": "a box is hg.Prism.box(x, y, z), sides in metres",
    "Sphere": "a ball is a file, ball.xml, that hg.Body reads: <mujoco><worldbody><body>"
    '<geom type="sphere" size="0.04"/></body></worldbody></mujoco>',
    "Mesh": 'a mesh is hg.Body("can.stl"), with scale=0.001 for one in millimetres',
    "Hand": "a robot, hand or arm, is hg.Scene(robot=…).articulated; a simulated one that is "
    "driven is hg.SimulatedHand",
}


if not TYPE_CHECKING:  # a type checker says itself what is not here

    def __getattr__(name: str) -> object:
        """Answer a name that is not here by where what it means is."""
        hint = _ELSEWHERE.get(name, "")
        if not hint and name.endswith(("Task", "Limit")):
            import mink

            if hasattr(mink, name):
                way = f"stack >> mink.{name}(…)"
                way = f"stack.within(mink.{name}(…))" if name.endswith("Limit") else way
                hint = f"mink has it, and it goes into a stack as it is: {way}"
        near = difflib.get_close_matches(name, __all__, 1)
        if not hint and near:
            hint = f"did you mean hg.{near[0]}?"
        raise AttributeError(f"hqp_grasp has no {name!r}" + (f"; {hint}" if hint else ""))
