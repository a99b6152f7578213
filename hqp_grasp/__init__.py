"""Grasping by touch, with control laws in strict order and within a robot's limits."""

from hqp_grasp.control.controller import Controller, Step
from hqp_grasp.control.forces import GRIP_LAWS, Felt, ForceLaw, Forces, Grip, Squeeze
from hqp_grasp.control.forms import ClippedForm, HierarchyForm, MemorylessForm, PaperForm
from hqp_grasp.control.hold import Hold, Press
from hqp_grasp.control.ik import ik_levels, solve_ik
from hqp_grasp.control.limits import ConfigurationLimit, StepLimit, VelocityLimit
from hqp_grasp.errors import (
    HqpGraspError,
    InputError,
    ModelError,
    ReachError,
    ResultsError,
    SingularTaskError,
    SolverError,
    TrialError,
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
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.touch.noisy import Noise
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

__all__ = [
    "GRIP_LAWS",
    "HQP",
    "AlignTask",
    "Body",
    "ClippedForm",
    "ConfigurationLimit",
    "Contact",
    "ContactSpaceTask",
    "ContactTask",
    "Controller",
    "Cylinder",
    "Driver",
    "DriverLimits",
    "Felt",
    "ForceLaw",
    "ForceTask",
    "Forces",
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
    "ModelError",
    "MomentTask",
    "Noise",
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
    "ik_levels",
    "lift",
    "load_history",
    "save_history",
    "sense",
    "solve_ik",
    "solvers",
    "stack_of",
]
