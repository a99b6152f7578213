"""The control laws, one file each; every one reads a Grasp and yields rows."""

from hqp_grasp.tasks.contact import ContactTask
from hqp_grasp.tasks.force import ForceTask
from hqp_grasp.tasks.kinematic import KinematicTask
from hqp_grasp.tasks.moment import MomentTask
from hqp_grasp.tasks.posture import PostureTask
from hqp_grasp.tasks.task import ContactSpaceTask, Task

__all__ = [
    "ContactSpaceTask",
    "ContactTask",
    "ForceTask",
    "KinematicTask",
    "MomentTask",
    "PostureTask",
    "Task",
]
