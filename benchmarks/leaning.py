"""What holds on walls that lean and surfaces that curve both ways, beside what balances.

    python benchmarks/leaning.py --starts 50 --seed 70

Cups (frusta, wider above) whose walls lean by 0, 1, 3, 5 and 8°, a sphere, an ellipsoid, a cylinder
on its side and a cone. With `--outside` the groceries of `make outside` too. Columns: trials that
end good; that end secure (a friction of 0.2 holds the last grasp, of 0.3 where DEMAND says so);
that felt such a grasp and do not end in one; the probe of the first such, and the one from which
all are, to the end (medians of the trials that have it); what keeps the others from balance, most
often.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from grid import End, Runs, command
from outside_objects import OBJECTS, scene_of

import hqp_grasp as hg
from hqp_grasp.experiments.record import secures
from hqp_grasp.mechanics import SECURE

RUNS = Runs(50, 70)
SIDES = 120  # of the polygon that stands for a circle
HEIGHT = 0.12  # [m]
RADIUS = 0.05  # [m] of a cup, half way up
CUPS = {f"cup {lean}°": lean for lean in (0, 1, 3, 5, 8)}
CONE = (0.045, 0.2)  # [m] radius of its base, height: walls lean by 12.7°
CURVED = {"sphere": (0.05, 0.05, 0.05), "ellipsoid": (0.06, 0.04, 0.04)}  # [m] semi-axes
LYING = (0.04, 0.07)  # [m] radius and half the length of a cylinder on its side
DEMAND = {"cone": 0.3, "cup 8°": 0.3}  # friction, where leaning takes most of SECURE or more


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
        if name in CURVED or name == "lying":
            kind = "cylinder" if name == "lying" else "ellipsoid"
            size = " ".join(map(str, CURVED.get(name, LYING)))
            turned = " euler='0 90 0'" if name == "lying" else ""
            geom = f"<geom type='{kind}' size='{size}'{turned}/>"
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


def scene(name: str) -> hg.Scene:
    """The scene of an object, its own or one of the groceries."""
    return scene_of(name) if name in OBJECTS else hg.Scene(object=body(name))


def holds(name: str, trial: hg.Trial, record: hg.Record) -> dict[str, float]:
    """Whether friction holds the last grasp, or only one before it, and from which probe on."""
    friction = DEMAND.get(name, SECURE)
    held = record.column("friction_demand") <= friction  # False where nothing was touched
    secure = secures(record.verdict_table(), friction)[0]
    return {
        "holds": float(secure),
        "left": float(held.any() and not secure),
        "first": float(held.argmax()) if held.any() else np.nan,
        "kept": float(len(held) - np.append(~held[::-1], True).argmax()) if held[-1] else np.nan,
    }


def line(name: str, ends: list[End]) -> str:
    """One row of the table."""
    good = sum(end.verdict == "good" for end in ends)
    own = {key: np.array([end.figures[key] for end in ends]) for key in ends[0].figures}
    counts = "".join(f"{own[key].sum():8.0f}" for key in ("holds", "left"))
    known = [own[key][~np.isnan(own[key])] for key in ("first", "kept")]
    at = "".join(f"{np.median(v):9g}" if len(v) else f"{'–':>9}" for v in known)
    why = Counter(end.why for end in ends if end.probe is None).most_common(1)
    return f"{name:11}{good:6}{counts}{at}  {'{} ({})'.format(*why[0]) if why else ''}"


def main(
    runs: Runs = RUNS, probes: int = 40, only: tuple[str, ...] = (), outside: bool = False
) -> None:
    """Print one line an object.

    Args:
        runs: trials; trial i of object s draws from SeedSequence([seed, s, i])
        probes: touches after the first
        only: names of objects, in the place of all
        outside: groceries too
    """
    names = only or (*CUPS, *CURVED, "lying", "cone", *(OBJECTS if outside else ()))
    cells = {name: hg.Trial(scene(name), hg.stack_of("fmk"), probes) for name in names}
    found = runs.of(cells, holds, apart=True)
    print(f"{runs}, {probes} probes\n")
    print(f"{'':11}{'good':>6}{'secure':>8}{'left':>8}{'first':>9}{'kept':>9}  not balanced")
    for name, ends in found.items():
        print(line(name, ends))


if __name__ == "__main__":
    command(main)
