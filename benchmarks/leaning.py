"""What holds on walls that lean and surfaces that curve both ways, beside what balances.

    python benchmarks/leaning.py --starts 50 --seed 70

Cups (frusta, wider above) whose walls lean by 0, 1, 3, 5 and 8°, a sphere, an ellipsoid and a cone.
With `--outside`, the groceries of `make outside`.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from outside_objects import OBJECTS, scene_of
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all
from hqp_grasp.experiments.record import SECURE_FRICTION

SIDES = 120  # of the polygon that stands for a circle
HEIGHT = 0.12  # [m]
RADIUS = 0.05  # [m] of a cup, half way up
CUPS = {f"cup {lean}°": lean for lean in (0, 1, 3, 5, 8)}
CONE = (0.045, 0.2)  # [m] radius of its base, height: walls lean by 12.7°
CURVED = {"sphere": (0.05, 0.05, 0.05), "ellipsoid": (0.06, 0.04, 0.04)}  # [m] semi-axes
DEMAND = {"cone": 0.3, "cup 8°": 0.3}  # where walls need more than SECURE_FRICTION or nearly so


def frustum(below: float, above: float, height: float) -> str:
    """An OBJ of a frustum with these radii [m]; above may be 0."""
    t = 2.0 * np.pi * np.arange(SIDES) / SIDES
    circle = np.column_stack([np.cos(t), np.sin(t), np.zeros(SIDES)])
    top = [0.0, 0.0, height]
    vertices = [np.zeros(3), np.array(top), *(below * circle), *(above * circle + top)]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices[: None if above > 0.0 else 2 + SIDES]]
    for i in range(SIDES):
        low, next_low = 3 + i, 3 + (i + 1) % SIDES
        high, next_high = (low + SIDES, next_low + SIDES) if above > 0.0 else (2, 2)
        lines += [f"f 1 {next_low} {low}", f"f {low} {next_low} {high}"]
        if above > 0.0:
            lines += [f"f {next_low} {next_high} {high}", f"f {high} {next_high} 2"]
    return "\n".join(lines) + "\n"


def body(name: str) -> hg.Body:
    """The object of that name."""
    with tempfile.TemporaryDirectory() as folder:
        if name in CURVED:
            size = " ".join(map(str, CURVED[name]))
            geom = f"<geom type='ellipsoid' size='{size}'/>"
            path = Path(folder) / f"{name}.xml"
            path.write_text(f"<mujoco><worldbody><body>{geom}</body></worldbody></mujoco>")
        else:
            radii = (CONE[0], 0.0, CONE[1])
            if name in CUPS:
                away = 0.5 * HEIGHT * np.tan(np.radians(CUPS[name]))
                radii = (RADIUS - away, RADIUS + away, HEIGHT)
            path = Path(folder) / "frustum.obj"
            path.write_text(frustum(*radii))
        return hg.Body(path)
