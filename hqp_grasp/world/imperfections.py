"""What keeps a real hand's readings and motions from being what is."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from hqp_grasp.errors import InputError, finite, not_negative, number, one_of, whole


@dataclass(frozen=True)
class Fault:
    """Something that breaks for a while, at one finger."""

    kind: str  # one of FAULTS
    finger: int
    begin: float  # [s] on the driver's clock
    duration: float = np.inf  # [s]; of a spike, one sample is enough

    def __post_init__(self) -> None:
        one_of("fault", self.kind, FAULTS)
        object.__setattr__(self, "finger", whole("Fault.finger", self.finger, 0))
        object.__setattr__(self, "begin", finite("Fault.begin", self.begin))
        duration = number("Fault.duration", self.duration)
        if not duration > 0.0:
            raise InputError(f"Fault.duration must be above 0, or inf; got {duration}")
        object.__setattr__(self, "duration", duration)


FAULTS = {
    "dropout": "the sensor reads zero",
    "freeze": "the sensor repeats its last sample",
    "spike": "the sensor reads SPIKE along z",
    "stall": "the finger's joint does not follow its servo",
}
SPIKE = 50.0  # [N]


@dataclass(frozen=True)
class Imperfections:
    """Each is off at 0, and each can be switched by itself; random ones are drawn from a seed.

    Those of the world that a controller does not know (where the object is, how large it is, its
    friction) belong to the scene that the simulated hand is given, not here.
    """

    force_noise: float = 0.0  # [N] standard deviation of each axis of each sample
    torque_noise: float = 0.0  # [N·m]
    force_bias: float = 0.0  # [N] standard deviation of each axis' constant error
    torque_bias: float = 0.0  # [N·m]
    force_drift: float = 0.0  # [N/min] standard deviation of each axis' steady drift
    torque_drift: float = 0.0  # [N·m/min]
    force_step: float = 0.0  # [N] quantisation
    torque_step: float = 0.0  # [N·m]
    latency: float = 0.0  # [s] from force to reading
    encoder_offset: float = 0.0  # [rad] standard deviation of each joint's constant error
    arm_offset: float = 0.0  # [rad] the same, of the arm's joints only: its calibration
    encoder_step: float = 0.0  # [rad] quantisation
    servo_error: float = 0.0  # [rad] standard deviation of where each move ends
    backlash: float = 0.0  # [rad] play between each servo and its joint
    gravity_error: float = 0.0  # [–] share of the weight by which the compensation errs
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        for at in fields(self)[:-1]:
            least = finite if at.name == "gravity_error" else not_negative
            value = least(f"Imperfections.{at.name}", getattr(self, at.name))
            object.__setattr__(self, at.name, value)
        if not isinstance(self.faults, tuple) or not all(isinstance(f, Fault) for f in self.faults):
            raise InputError(f"Imperfections.faults must be a tuple of Fault; got {self.faults!r}")

    @classmethod
    def preset(cls, name: str | None, **changes: Any) -> Imperfections:
        """The imperfections of that name, None for none; `changes` replaces single values."""
        if name is None:
            return cls(**changes)
        return replace(PRESETS[one_of("preset", name, PRESETS)], **changes)


PRESETS = {
    # A small six-axis load cell in each fingertip, and a cable-driven arm. [C]: chosen, because
    # no data of the paper's robot are published.
    "loadcell": Imperfections(
        force_noise=0.02,  # [C] three counts of a cell that resolves 1/160 N
        torque_noise=2e-4,  # [C] the force's, at 1 cm
        force_bias=0.1,  # [C] what zeroing leaves; weighing before each touch takes it away
        torque_bias=1e-3,  # [C] likewise
        force_drift=0.02,  # [C] the noise, once a minute: warming up
        torque_drift=2e-4,  # [C]
        force_step=1 / 160,  # [C] what small cells of 25 N resolve
        torque_step=1 / 32000,  # [C] the same cell, 1/32 N·mm
        latency=2e-3,  # [C] two samples at 1 kHz
        encoder_offset=np.radians(0.1),  # [C] a calibrated arm: 2 mm at 1 m
        encoder_step=2 * np.pi / 4096 / 10,  # [C] 12 bits at the motor, geared down by ten
        servo_error=1e-3,  # [C] friction in the transmission
        backlash=0.0,  # cables have none
        gravity_error=0.02,  # [C] masses known to 2 %
    ),
}


class SensorErrors:
    """The errors of one run: constants drawn once, noise drawn as samples are taken."""

    def __init__(
        self, about: Imperfections, k: int, arm: np.ndarray, rng: np.random.Generator
    ) -> None:
        self.about = about
        self._rng = rng
        per_axis = lambda force, torque: np.tile(np.repeat([force, torque], 3), (k, 1))  # noqa: E731
        draw = lambda force, torque: per_axis(force, torque) * rng.standard_normal((k, 6))  # noqa: E731
        self._bias = draw(about.force_bias, about.torque_bias)
        self._drift = draw(about.force_drift, about.torque_drift) / 60.0
        self._noise = per_axis(about.force_noise, about.torque_noise)
        self._step = per_axis(about.force_step, about.torque_step)
        spread = about.encoder_offset + about.arm_offset * arm  # arm (n,): True of its joints
        self.encoder_offset = spread * rng.standard_normal(len(arm))  # [rad] of each joint
        self._frozen: dict[Fault, np.ndarray] = {}
        self._perfect = not any(
            array.any() for array in (self._bias, self._drift, self._noise, self._step)
        )

    def wrench(self, time: np.ndarray, true: np.ndarray) -> np.ndarray:
        """What the sensors say (t, k, 6) of the `true` wrenches at `time` (t,) [s]."""
        if self._perfect:
            felt = true
        else:
            felt = true + self._bias + self._drift * time[:, None, None]
            if self._noise.any():
                felt += self._noise * self._rng.standard_normal(true.shape)
            if self._step.any():
                step = np.where(self._step > 0.0, self._step, 1.0)
                felt = np.where(self._step > 0.0, step * np.round(felt / step), felt)
        for fault in self.about.faults:
            broken = self._lasts(fault, time)
            if fault.kind == "stall" or not broken.any():
                continue
            felt = felt.copy()
            if fault.kind == "dropout":
                felt[broken, fault.finger] = 0.0
            elif fault.kind == "spike":
                felt[np.argmax(broken), fault.finger, 2] += SPIKE
            else:
                first = self._frozen.setdefault(fault, felt[np.argmax(broken), fault.finger])
                felt[broken, fault.finger] = first
        return felt

    def stalled(self, time: float) -> list[int]:
        """Fingers whose joints do not follow."""
        now = np.array([time])
        return [
            fault.finger
            for fault in self.about.faults
            if fault.kind == "stall" and self._lasts(fault, now)[0]
        ]

    @staticmethod
    def _lasts(fault: Fault, time: np.ndarray) -> np.ndarray:
        return (time >= fault.begin) & (time < fault.begin + fault.duration)

    def joints(self, true: np.ndarray) -> np.ndarray:
        """What the encoders say of the true angles (…, n) [rad]."""
        felt = true + self.encoder_offset
        step = self.about.encoder_step
        return step * np.round(felt / step) if step else felt

    def miss(self, n: int) -> np.ndarray:
        """Where a move ends beside its target (n,) [rad]."""
        if not self.about.servo_error:
            return np.zeros(n)
        return self.about.servo_error * self._rng.standard_normal(n)
