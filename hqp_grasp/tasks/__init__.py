"""The control laws, one file each; every one reads a Grasp and yields rows."""

from hqp_grasp.tasks.align import AlignTask
from hqp_grasp.tasks.contact import ContactTask
from hqp_grasp.tasks.contact_space import ContactSpaceTask
from hqp_grasp.tasks.force import ForceTask
from hqp_grasp.tasks.kinematic import KinematicTask
from hqp_grasp.tasks.letters import stack_of
from hqp_grasp.tasks.limit import Limit, MinkLimit, Priority
from hqp_grasp.tasks.moment import MomentTask
from hqp_grasp.tasks.posture import PostureTask
from hqp_grasp.tasks.stack import MinkTask, Stack, Task

__all__ = [
    "AlignTask",
    "ContactSpaceTask",
    "ContactTask",
    "ForceTask",
    "KinematicTask",
    "Limit",
    "MinkLimit",
    "MinkTask",
    "MomentTask",
    "PostureTask",
    "Priority",
    "Stack",
    "Task",
    "stack_of",
]
