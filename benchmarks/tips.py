"""What tips that are no balls are good for: three hands grasp, by two forms.

    python benchmarks/tips.py --trials 20 --seed 906

The trident is that of docs/any-robot.md, as the page shows it; the others are in
benchmarks/robots/.
"""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

from grid import Runs, command, table

import hqp_grasp as hg

RUNS = Runs(20, 906)
ROOT = Path(__file__).parents[1]
OBJECTS = {"cylinder": hg.Cylinder(0.05), "hexagon": hg.Prism.regular(6, 0.05)}


def trident(folder: Path) -> Path:
    """Write the hand that docs/any-robot.md shows; return its description."""
    page = (ROOT / "docs" / "any-robot.md").read_text(encoding="utf-8")
    for name, text in re.findall(r'^```text title="(.+?)"\n(.*?)^```', page, re.DOTALL | re.M):
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "trident.toml"


def main(
    runs: Runs = RUNS,
    probes: int = 40,
    objects: tuple[str, ...] = ("cylinder", "hexagon"),
    forms: tuple[str, ...] = ("hierarchy", "paper"),
) -> None:
    """Print one row a hand, object and form.

    Args:
        runs: trials
        probes: touches after the first
        objects: what is grasped: cylinder, hexagon
        forms: of the controller
    """
    with TemporaryDirectory() as folder:
        robots = {
            "trident": trident(Path(folder)),
            "capsules": ROOT / "benchmarks" / "robots" / "capsules.toml",
            "boxes": ROOT / "benchmarks" / "robots" / "boxes.toml",
        }
        scenes = {
            f"{name}, {thing}": hg.Scene(robots[name], OBJECTS[thing])
            for name, thing in product(robots, objects)
        }
        cells = {
            f"{name}, {form}": hg.Trial(scene, hg.stack_of("fmk"), probes, form)
            for (name, scene), form in product(scenes.items(), forms)
        }
        print(f"{runs}, {probes} probes\n")
        print(table(runs.of(cells)))


if __name__ == "__main__":
    command(main)
