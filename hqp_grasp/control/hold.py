"""Holding: from what is felt while the hand presses to what it presses with next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hqp_grasp.control.forces import Grip, Squeeze
from hqp_grasp.errors import InputError, instance, whole
from hqp_grasp.grasp import Grasp, Miss, Missed

RESERVE = 0.5  # share of the friction believed in that the load may use of all contacts together
RELAXING = 0.97  # by which the grip becomes weaker at a step, at most
FOLLOWED = 0.9  # share of the forces asked for that a hand which follows is felt to press with
ROUNDING = 1e-3  # [N] that normal forces may fall short of what is asked by


@dataclass(frozen=True, eq=False)
class Press:
    """What to press with, and how it stands."""

    torque: np.ndarray  # (n,) [N·m] for `Driver.press`
    strength: float  # F [N] mean normal force that is asked for
    squeeze: Squeeze  # the forces behind it, as last computed
    used: float = 0.0  # friction |t|/a that the contact nearest to slipping was felt to use
    load: float = 0.0  # [N] the contacts' net force on the object, upwards
    blind: int = 0  # steps in a row that felt no grasp, or found no forces,
    straining: int = 0  # or contacts near slipping that could not be pressed harder
    reason: str = ""  # why the object should be set down; empty while it is safe


@dataclass(frozen=True)
class Hold:
    """Presses as its grip says, harder where contacts come near to slipping.

    `step` is a pure function of what is felt and of the step before. The grip is as strong as it
    must be for the load to use no more than RESERVE of the friction believed in, and no contact
    more than all of it; it relaxes slowly, never below `grip.force`. Where nothing is felt, or no
    forces are found, the last torques are kept. The object should be set down, and `Press.reason`
    says so, where that lasts for `patience` steps, or where contacts beyond the friction believed
    in cannot be pressed harder.
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
        used, needed, mean, load = self._needed(felt)
        before = self.grip.force if last is None else last.strength
        wanted = max(needed, RELAXING * before, self.grip.force)
        strength = min(wanted, self.grip.most)
        warm = None if last is None else last.squeeze
        squeeze = replace(self.grip, force=strength).solve(felt, warm=warm)
        if squeeze.torque is None:
            if last is None:
                raise InputError(f"Hold: {squeeze.reason}")
            return replace(self._kept(last, squeeze.reason), used=used, load=load)
        straining, reason = 0, ""
        if last is not None and used > self.grip.friction and _is_all(last.squeeze, felt, mean):
            straining = last.straining + (wanted > self.grip.most or _is_weak(squeeze))
        if straining >= self.patience:
            reason = (
                f"a contact uses friction of {used:.2f}, {self.grip.friction:g} is believed, and "
                f"the hand cannot press harder than {mean:.3g} N a contact"
            )
        return Press(squeeze.torque, strength, squeeze, used, load, 0, straining, reason)

    def _needed(self, felt: Grasp) -> tuple[float, float, float, float]:
        """The largest |t_i|/a_i; the strength [N] it takes; the mean a_i [N]; the load [N].

        All are 0 where no wrench is felt.
        """
        if any(contact.wrench is None for contact in felt.contacts):
            return 0.0, 0.0, 0.0, 0.0
        f = np.array([contact.wrench[:3] for contact in felt.contacts])  # type: ignore[index]
        a = (f * felt.normals).sum(axis=1)
        t = np.linalg.norm(f - a[:, None] * felt.normals, axis=1)
        net, mean = f.sum(axis=0), float(a.mean())
        used = float((t / np.maximum(a, np.finfo(float).tiny)).max())
        shared = float(np.linalg.norm(net)) / (felt.k * RESERVE * self.grip.friction)
        return used, max(shared, mean * used / self.grip.friction), mean, -float(net[2])

    def _blind(self, felt: Missed, last: Press | None) -> Press:
        if last is None:
            raise InputError(
                f"Hold begins with a grasp, and nothing was felt yet: {felt.reason.value} "
                f"({felt.where})"
            )
        kept = self._kept(last, f"{felt.reason.value} ({felt.where})")
        if felt.reason is Miss.BLOCKED:  # the driver stopped: it presses no more
            return replace(kept, reason=f"{felt.reason.value} ({felt.where})")
        return kept

    def _kept(self, last: Press, why: str) -> Press:
        """The last torques once more, which should end where that lasts."""
        blind = last.blind + 1
        return replace(last, blind=blind, reason=why if blind >= self.patience else last.reason)


def _is_weak(squeeze: Squeeze) -> bool:
    """True where limits leave less than the strength that was asked for."""
    return any(r.law == "grip strength" and r.short > ROUNDING for r in squeeze.reports)


def _is_all(squeeze: Squeeze, felt: Grasp, mean: float) -> bool:
    """True where `mean` [N], a contact's normal force, is what was asked: the hand has followed."""
    assert squeeze.forces is not None
    asked = float(-(squeeze.forces * felt.normals).sum(axis=1).mean())
    return mean >= FOLLOWED * asked
