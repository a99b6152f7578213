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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from outside_objects import OBJECTS, scene_of
from tqdm import tqdm

import hqp_grasp as hg
from hqp_grasp.experiments.executor import run_all
from hqp_grasp.experiments.record import secures
from hqp_grasp.mechanics import SECURE

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


@dataclass(frozen=True)
class Work:
    """The trials of each object, one after the other."""

    names: tuple[str, ...]
    starts: int
    probes: int
    seed: int

    def __call__(self, number: int) -> tuple[str, bool, tuple[float, ...], str | None]:
        """Verdict, whether secure by DEMAND, friction demand of each probe, why unbalanced."""
        s, i = divmod(number, self.starts)
        name = self.names[s]
        record = hg.Trial(scene(name), hg.stack_of("fmk"), self.probes).attempt((self.seed, s, i))
        demand = record.column("friction_demand")  # NaN where nothing was touched
        return (
            record.verdict,
            secures(record.verdict_table(), limit(name))[0],
            tuple(demand),
            record.unbalanced,
        )


def limit(name: str) -> float:
    """The friction that has to hold the object of that name."""
    return DEMAND.get(name, SECURE)


def line(name: str, ends: list[tuple[str, bool, tuple[float, ...], str | None]]) -> str:
    """One row of the table."""
    good = sum(verdict == "good" for verdict, *_ in ends)
    secure = sum(found for _, found, *_ in ends)
    holds = [np.array(demand) <= limit(name) for _, _, demand, _ in ends]
    first = [int(v.argmax()) for v in holds if v.any()]
    stays = [len(v) - int(np.append(~v[::-1], True).argmax()) for v in holds if v[-1]]
    left = sum(v.any() and not found for v, (_, found, *_) in zip(holds, ends, strict=True))
    at = "".join(f"{np.median(v):9g}" if v else f"{'–':>9}" for v in (first, stays))
    why = Counter(reason for *_, reason in ends if reason is not None).most_common(1)
    told = f"{why[0][0]} ({why[0][1]})" if why else ""
    return f"{name:11}{good:6}{secure:8}{left:8}{at}  {told}"


def main(
    starts: int = 50,
    seed: int = 70,
    probes: int = 40,
    only: tuple[str, ...] = (),
    outside: bool = False,
    jobs: int = 2,
) -> None:
    """Print one line an object.

    Args:
        starts: of each object
        seed: trial i of object s draws from SeedSequence([seed, s, i])
        probes: touches after the first
        only: names of objects, in the place of all
        outside: groceries too
        jobs: processes
    """
    names = only or (*CUPS, *CURVED, "lying", "cone", *(OBJECTS if outside else ()))
    work = Work(names, starts, probes, seed)
    numbers = range(len(names) * starts)
    done = dict(tqdm(run_all(work, numbers, jobs), total=len(numbers)))
    print(f"{starts} starts of each, {probes} probes, seed {seed}\n")
    print(f"{'':11}{'good':>6}{'secure':>8}{'left':>8}{'first':>9}{'kept':>9}  not balanced")
    for s, name in enumerate(names):
        print(line(name, [done[s * starts + i] for i in range(starts)]))


if __name__ == "__main__":
    tyro.cli(main)
