"""Contacts felt with errors: what a probe of exact distances lacks of a real hand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hqp_grasp.errors import InputError, instance, not_negative
from hqp_grasp.grasp import Contact, Grasp, Missed
from hqp_grasp.touch.probe import Probe
from hqp_grasp.world.robot import Robot


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is felt of a contact, along each axis.

    A round tip is touched where its normal says, whatever the place felt: see `Robot.grasp`.
    """

    normal: float = 0.0  # [rad] about the two axes across the normal
    position: float = 0.0  # [m]

    def __post_init__(self) -> None:
        for name in ("normal", "position"):
            value = not_negative(f"Noise.{name}", getattr(self, name))
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class NoisyProbe:
    """What another probe feels, with noise on every contact; joint angles stay exact."""

    probe: Probe
    robot: Robot
    noise: Noise
    rng: np.random.Generator
    felt: list[Grasp | Missed] = field(default_factory=list)  # each touch as it is, no noise on it

    def __post_init__(self) -> None:
        if not callable(getattr(self.probe, "touch", None)):
            raise InputError(f"NoisyProbe.probe must have a method touch; got {self.probe!r}")
        instance("NoisyProbe.robot", self.robot, Robot)
        instance("NoisyProbe.noise", self.noise, Noise)
        instance("NoisyProbe.rng", self.rng, np.random.Generator)

    def touch(self, q_target: np.ndarray) -> Grasp | Missed:
        """Touch at q_target (n,) [rad], and return the grasp as it is felt."""
        self.felt.append(self.probe.touch(q_target))
        true = self.felt[-1]
        if isinstance(true, Missed):
            return true
        contacts = [self._felt(contact) for contact in true.contacts]
        return self.robot.grasp(true.q, contacts, true.other_links)

    def _felt(self, contact: Contact) -> Contact:
        normal = contact.normal + self.noise.normal * self.rng.standard_normal(3)
        position = contact.position + self.noise.position * self.rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        return replace(contact, normal=normal, position=position, noise=self.noise.normal)
