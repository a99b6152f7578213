"""What strict, damped and rank-truncated answers do as two levels become parallel.

    python benchmarks/near_singular.py --plot out/near_singular.png

Three unknowns, three levels: x₁ = 1 ▷ cos(a) x₁ + sin(a) x₂ = 0.7 ▷ x = 0. As the angle a shrinks
the two rows that lead become one, and they disagree. Each answer is drawn as a line over a: the
length of x, and what the first and the second level are left with.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import tyro

import hqp_grasp as hg

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ASKED = (1.0, 0.7)  # of the first two levels
BOX = 2.0  # the limit on every unknown
FLOOR = 1e-17  # drawn in the place of zero
STYLES = ("-", "--", "-", "--", "-.", ":")


def tasks(angle: float) -> list[hg.Level]:
    return [
        hg.Level.equal([[1.0, 0.0, 0.0]], ASKED[:1], "first"),
        hg.Level.equal([[np.cos(angle), np.sin(angle), 0.0]], ASKED[1:], "second"),
        hg.Level.equal(np.eye(3), np.zeros(3), "rest"),
    ]


def answers(angle: float, damping: float, tolerance: float) -> dict[str, np.ndarray]:
    """x (3,) of each choice."""
    levels = tasks(angle)
    strict = hg.HQP()
    limited = [hg.Level(np.eye(3), np.full(3, -BOX), np.full(3, BOX), "box"), *levels]
    return {
        "strict projection": hg.Projection().solve(levels).x,
        "strict HQP in a box": strict.solve(limited).x,
        "SR-inverse": hg.Projection(damping=damping).solve(levels).x,
        "damped HQP in a box": strict.solve(strict.damped(limited, damping)).x,
        "truncated projection": hg.Projection(rank_tolerance=tolerance).solve(levels).x,
        "truncated HQP in a box": hg.HQP(rank_tolerance=tolerance).solve(limited).x,
    }


def draw(angles: np.ndarray, seen: dict[str, np.ndarray], title: str, path: Path) -> None:
    """Three panels over the angle: `seen` holds (angles, 3) for each choice."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 4.2), sharex=True)
    heads = ("length of x", "left of the first level", "left of the second level")
    for column, (axis, head) in enumerate(zip(axes, heads, strict=True)):
        for i, (name, values) in enumerate(seen.items()):
            line = np.maximum(values[:, column], FLOOR)
            axis.plot(angles, line, STYLES[i], color=f"C{i}", label=name, linewidth=3.2 - 0.4 * i)
        axis.set(title=head, xlabel="angle between the levels [rad]", xscale="log", yscale="log")
        axis.set_xticks(10.0 ** np.arange(-14, 0, 3))
        axis.grid(alpha=0.3)
    axes[0].invert_xaxis()  # shared
    for axis in axes[1:]:
        axis.set_ylim(FLOOR / 3, 3)
    axes[1].legend(fontsize=8)
    figure.suptitle(f"{title}; {FLOOR:g} stands for zero", fontsize=10)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(f"\nfigure  {path}")


def main(
    damping: float = 1e-4,
    tolerance: float = 1e-6,
    per_decade: int = 4,
    plot: Path = Path("out/near_singular.png"),
) -> None:
    """Print and draw ‖x‖ and the residuals of both levels over angles 1e-1 … 1e-14.

    Args:
        damping: λ of the damped answers
        tolerance: rank tolerance of the truncated answers
        per_decade: angles in each decade; the table shows every second decade
        plot: where to
    """
    exponents = np.linspace(1, 14, 13 * per_decade + 1)
    seen: dict[str, list[list[float]]] = {}
    print("in each cell: ‖x‖, left of the first level, left of the second\n")
    for i, exponent in enumerate(exponents):
        angle = 10.0**-exponent
        levels = tasks(angle)
        found = answers(angle, damping, tolerance)
        for name, x in found.items():
            left = [float(np.linalg.norm(level.residual(x))) for level in levels[:2]]
            seen.setdefault(name, []).append([float(np.linalg.norm(x)), *left])
        if i == 0:
            print("angle   " + "".join(f"{name:>24}" for name in seen))
        if i % (2 * per_decade) == 0 or i == len(exponents) - 1:
            cells = (" ".join(f"{v:.0e}" for v in values[-1]) for values in seen.values())
            print(f"{angle:<8.0e}" + "".join(f"{cell:>24}" for cell in cells))
    title = f"box ±{BOX:g}, λ = {damping:g}, rank tolerance {tolerance:g}"
    draw(10.0**-exponents, {k: np.array(v) for k, v in seen.items()}, title, plot)


if __name__ == "__main__":
    tyro.cli(main)
