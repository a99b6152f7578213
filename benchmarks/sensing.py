"""How well a fingertip knows where it is touched: `sense` against MuJoCo's own contacts, and noise.

    python benchmarks/sensing.py --starts 120 --seed 0

Simulated fingers press a fixed cylinder with 1 to 5 N, at two frictions, on contacts of three
kinds. What `sense` says of one noise-free sample is compared with the contact's normal n and
with center − radius · n, both in the tip's frame. The second table is of synthetic wrenches with
noise, one sample each.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import hqp_grasp as hg
from hqp_grasp.touch.physical import payload, weight
from hqp_grasp.world.physics import CONTACTS

FRICTIONS = (0.4, 0.8)
WANTED = (0.02, 0.1)  # [mm], [°] on stiff contacts
NOISES = ((3e-3, 1.6e-5), (12.5e-3, 6e-5), (20e-3, 2e-4))  # [N], [N·m] of each axis
FORCES = (0.3, 0.5, 1.0, 2.0, 3.0, 5.0)  # [N]
PRESSED = 0.9  # [N] at least, to count: below, the finger has slid off
AIM = 2.0  # [°]


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Between two unit vectors [°]; exact for small ones."""
    return float(np.degrees(2.0 * np.arcsin(min(1.0, np.linalg.norm(a - b) / 2.0))))


def against_mujoco(starts: np.ndarray, scene: hg.Scene, contact: str, seed: int) -> np.ndarray:
    """Of each contact: error of position [mm], of normal [°], force [N], torque about n [mm·N]."""
    rng = np.random.default_rng(seed)
    robot, found = scene.articulated, []
    load = payload(robot)
    for friction in FRICTIONS:
        hand = hg.SimulatedHand(scene, hg.Physics(contact, friction=friction), links="pass")
        for q in starts:
            hand.place(q)
            probe = hg.PhysicalProbe(hand, robot, force=rng.uniform(1.0, 5.0))
            if isinstance(probe.touch(q), hg.Missed):
                continue
            wrench = hand.wait(0.5).wrench[-1]
            truth = hand.truth()
            if truth.grasp is None:
                continue
            frames = truth.R_world_tip
            for i, pushed in enumerate(wrench - weight(load, frames)):
                if np.linalg.norm(pushed[:3]) < PRESSED:
                    continue
                position, normal = hg.sense(pushed, float(robot.tip_radius[i]))
                true = frames[i].T @ truth.grasp.contacts[i].normal
                off = 1e3 * float(np.linalg.norm(position + robot.tip_radius[i] * true))
                spin = 1e3 * abs(float(pushed[3:] @ true))
                found.append((off, angle(normal, true), np.linalg.norm(pushed[:3]), spin))
    return np.array(found)


def with_noise(noise: tuple[float, float], force: float, count: int, seed: int) -> np.ndarray:
    """Errors of the normal [°] of one sample each, friction up to 0.6."""
    rng, radius = np.random.default_rng(seed), 0.008
    errors = []
    for _ in range(count):
        n = rng.normal(size=3)
        n /= np.linalg.norm(n)
        slide = np.cross(n, rng.normal(size=3))
        f = n + rng.uniform(0.0, 0.6) * slide / np.linalg.norm(slide)
        f *= force / np.linalg.norm(f)
        wrench = np.concatenate([f, np.cross(-radius * n, f) + rng.uniform(-0.01, 0.01) * n])
        wrench += np.repeat(noise, 3) * rng.normal(size=6)
        errors.append(angle(hg.sense(wrench, radius)[1], n))
    return np.array(errors)


def force_for(wanted: float, errors: tuple[float, ...]) -> str:
    """The force with an error of `wanted` [°], between those of FORCES."""
    if errors[0] < wanted:
        return f"less than {FORCES[0]:g} N"
    log = np.interp(-np.log(wanted), -np.log(errors), np.log(FORCES))
    return f"{np.exp(log):.2f} N"


def main(
    starts: int = 120, seed: int = 0, count: int = 2000, plot: Path = Path("out/sensing.png")
) -> None:
    """Print both tables, and draw the second.

    Args:
        starts: postures to press from, at each friction and kind of contact
        seed: trial i draws from SeedSequence([seed, i])
        count: synthetic wrenches for each noise and force
        plot: where to
    """
    scene = hg.Scene(object=hg.Cylinder(radius=0.05))
    geometric = hg.GeometricProbe(scene, "pass")
    drawn = [
        hg.Start().draw(scene, lambda _: geometric, np.random.default_rng([seed, i])).grasp.q
        for i in range(starts)
    ]
    print("noise-free, against MuJoCo's own contact: median / 95 % / worst")
    for contact in CONTACTS:
        found = against_mujoco(np.array(drawn), scene, contact, seed)
        mm, degrees = np.percentile(found[:, :2], [50, 95, 100], axis=0).T
        within = (found[:, :2] <= WANTED).all(axis=1).mean()
        print(
            f"{contact:8}{len(found):5} contacts  "
            f"{' / '.join(f'{v:.4f}' for v in mm)} mm   {' / '.join(f'{v:.3f}' for v in degrees)}°"
            f"   within {WANTED[0]} mm and {WANTED[1]}°: {within:.1%}"
            f"   {found[:, 2].min():.1f} to {found[:, 2].max():.1f} N,"
            f" torque about the normal up to {found[:, 3].max():.1f} mm·N"
        )
    print(f"\nwith noise, error of the normal, median / 95 %, {count} wrenches each")
    figure, axis = plt.subplots(figsize=(6.5, 4.2), layout="constrained")
    for n, noise in enumerate(NOISES):
        name = f"{1e3 * noise[0]:g} mN, {1e3 * noise[1]:g} mN·m"
        seen = [np.percentile(with_noise(noise, f, count, seed), [50, 95]) for f in FORCES]
        axis.loglog(FORCES, [middle for middle, _ in seen], f"C{n}-", label=f"{name}: median")
        axis.loglog(FORCES, [most for _, most in seen], f"C{n}--", label="95 %")
        print(name)
        for force, (middle, most) in zip(FORCES, seen, strict=True):
            print(f"  {force:4.1f} N   {middle:6.2f}° / {most:6.2f}°")
        middle, most = (force_for(AIM, errors) for errors in zip(*seen, strict=True))
        print(f"  {AIM:g}° needs {middle} in the median, {most} for 95 %")
    axis.axhline(AIM, color="k", ls=":")
    axis.set(xlabel="force at the tip [N]", ylabel="error of the normal, one sample [°]")
    axis.set_xticks(FORCES, [f"{force:g}" for force in FORCES])
    axis.set_xticks([], minor=True)
    axis.set_yticks([0.1, 1.0, 10.0], ["0.1", "1", "10"])
    axis.legend(fontsize=8)
    plot.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(plot, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    tyro.cli(main)
