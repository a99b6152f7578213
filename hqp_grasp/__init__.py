"""Grasping by touch, with control laws in strict order and within a robot's limits."""

from hqp_grasp.errors import (
    HqpGraspError,
    InputError,
    ModelError,
    ReachError,
    ResultsError,
    SingularTaskError,
    SolverError,
)
from hqp_grasp.grasp import Contact, Grasp
from hqp_grasp.hqp import HQP, solvers
from hqp_grasp.ik import ik_levels, solve_ik
from hqp_grasp.level import Level, LevelReport, Solution
from hqp_grasp.limits import ConfigurationLimit, Limit, MinkLimit, StepLimit, VelocityLimit
from hqp_grasp.probe import GeometricProbe, Miss, Missed, Probe
from hqp_grasp.projection import Projection
from hqp_grasp.robot import Robot, RobotDescription
from hqp_grasp.scene import Cylinder, Prism, Scene
from hqp_grasp.stack import Stack
from hqp_grasp.study import Study
from hqp_grasp.tasks import (
    ContactTask,
    ForceTask,
    KinematicTask,
    MomentTask,
    PostureTask,
    Task,
)
from hqp_grasp.trial import Record, Trial

__all__ = [
    "HQP",
    "ConfigurationLimit",
    "Contact",
    "ContactTask",
    "Cylinder",
    "ForceTask",
    "GeometricProbe",
    "Grasp",
    "HqpGraspError",
    "InputError",
    "KinematicTask",
    "Level",
    "LevelReport",
    "Limit",
    "MinkLimit",
    "Miss",
    "Missed",
    "ModelError",
    "MomentTask",
    "PostureTask",
    "Prism",
    "Probe",
    "Projection",
    "ReachError",
    "Record",
    "ResultsError",
    "Robot",
    "RobotDescription",
    "Scene",
    "SingularTaskError",
    "Solution",
    "SolverError",
    "Stack",
    "StepLimit",
    "Study",
    "Task",
    "Trial",
    "VelocityLimit",
    "ik_levels",
    "solve_ik",
    "solvers",
]
