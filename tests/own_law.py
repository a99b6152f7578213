"""Control laws as a user would write them, where worker processes can import them."""

import os
from dataclasses import dataclass

import numpy as np

from hqp_grasp.tasks import ContactSpaceTask, ForceTask


@dataclass(frozen=True)
class HeightTask(ContactSpaceTask):
    """All contacts at one height [m]."""

    def error(self, grasp):
        z = grasp.positions[:, 2]
        return z - z.mean()

    def contact_jacobian(self, grasp):
        along_z = np.kron(np.eye(grasp.k), [0.0, 0.0, 1.0])
        return along_z - along_z.mean(axis=0)


def blas_threads():
    return os.environ.get("OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class ManyThreadsTask(ForceTask):
    """The force law, never in a worker of a study."""

    def error(self, grasp):
        if blas_threads() == "1":
            raise RuntimeError("1 BLAS threads")
        return super().error(grasp)
