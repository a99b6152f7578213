"""Holding: from what is felt while the hand presses to what it presses with next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hqp_grasp.control.forces import Grip, Squeeze
from hqp_grasp.errors import InputError, instance, whole
from hqp_grasp.grasp import Grasp, Miss, Missed

RESERVE = 0.5  # share of the friction believed in that the load uses of all contacts together,
ALARM = 0.8  # or any one contact, before the grip grows
GROWTH, RELAXING = 1.25, 0.97  # by which the grip grows, or becomes weaker, at a step, at most
ROUNDING = 1e-3  # [N] that normal forces may fall short of what is asked by


@dataclass(frozen=True, eq=False)
class Press:
    """What to press with, and how it stands."""

    torque: np.ndarray  # (n,) [N·m] for `Driver.press`
    strength: float  # F [N] mean normal force that is asked for
    squeeze: Squeeze  # the forces behind it, as last computed
    used: float = 0.0  # friction |t|/a that the contact nearest to slipping was felt to use
    load: float = 0.0  # [N] the contacts' net force on the object, upwards
    blind: int = 0  # steps in a row that felt no grasp,
    straining: int = 0  # or contacts near slipping that could not be pressed harder
    reason: str = ""  # why the object should be set down; empty while it is safe


@dataclass(frozen=True)
class Hold:
    """Presses as its grip says, harder where contacts come near to slipping.

    `step` is a pure function of what is felt and of the step before. The grip grows until the load
    uses no more than RESERVE of the friction believed in, and no contact more than ALARM of it; it
    relaxes slowly where less is used, never below `grip.force`. Where nothing is felt the last
    torques are kept. The object should be set down, and `Press.reason` says so, where for
    `patience` steps nothing was felt, or contacts beyond the friction believed in could not be
    pressed harder.
    """

    grip: Grip
    patience: int = 3

    def __post_init__(self) -> None:
        instance("Hold.grip", self.grip, Grip)
        object.__setattr__(self, "patience", whole("Hold.patience", self.patience, 1))

    def step(self, felt: Grasp | Missed, last: Press | None = None) -> Press:
        """What to press with after `felt`, as `PhysicalProbe.feel` or `touch` brings it.

        Raises InputError where nothing was felt yet, and for a grasp on which the first forces
        cannot be found.
        """
        if isinstance(felt, Missed):
            return self._blind(felt, last)
        used, shared, load = _friction_used(felt)
        strength = self.grip.force if last is None else last.strength
        growth = max(shared / RESERVE, used / ALARM) / self.grip.friction
        wanted = strength * min(max(growth, RELAXING), GROWTH)
        wanted = min(max(wanted, self.grip.force), self.grip.most)
        warm = None if last is None else last.squeeze
        squeeze = replace(self.grip, force=wanted).solve(felt, warm=warm)
        if squeeze.torque is None:
            if last is None:
                raise InputError(f"Hold: {squeeze.reason}")
            return replace(last, used=used, load=load, blind=0, reason=squeeze.reason)
        straining, reason = 0, ""
        if used > self.grip.friction and not self._can_grow(squeeze, wanted):
            straining = 1 if last is None else last.straining + 1
        if straining >= self.patience:
            reason = (
                f"a contact uses friction of {used:.2f}, {self.grip.friction:g} is believed, and "
                f"the hand cannot press harder than {wanted:.3g} N a contact"
            )
        return Press(squeeze.torque, wanted, squeeze, used, load, 0, straining, reason)

    def _can_grow(self, squeeze: Squeeze, strength: float) -> bool:
        weak = any(r.law == "grip strength" and r.short > ROUNDING for r in squeeze.reports)
        return strength < self.grip.most and not weak

    def _blind(self, felt: Missed, last: Press | None) -> Press:
        if last is None:
            raise InputError(
                f"Hold begins with a grasp, and nothing was felt yet: {felt.reason.value} "
                f"({felt.where})"
            )
        blind = last.blind + 1
        why = f"{felt.reason.value} ({felt.where})"
        gone = blind >= self.patience or felt.reason is Miss.BLOCKED
        return replace(last, blind=blind, reason=why if gone else last.reason)


def _friction_used(grasp: Grasp) -> tuple[float, float, float]:
    """Of the forces felt: the largest |t_i|/a_i, |Σ f_i|/Σ a_i, and the net force upwards [N].

    All are 0 where no wrench is felt.
    """
    if any(contact.wrench is None for contact in grasp.contacts):
        return 0.0, 0.0, 0.0
    f = np.array([contact.wrench[:3] for contact in grasp.contacts])  # type: ignore[index]
    a = (f * grasp.normals).sum(axis=1)
    t = np.linalg.norm(f - a[:, None] * grasp.normals, axis=1)
    least, net = np.finfo(float).tiny, f.sum(axis=0)
    used, shared = (t / np.maximum(a, least)).max(), np.linalg.norm(net) / max(a.sum(), least)
    return float(used), float(shared), -float(net[2])
