"""An upright prism over any convex outline, read from a file: no Python needed.

hqp-grasp run prism --corners FILE --stack fmk --trials 40 --probes 40 --seed 0 --jobs 2
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import Settings, main
from hqp_grasp.world.objects import centroid, read_corners

MOVED = 1e-4  # [m] from the origin: a centroid nearer than this stays where it is


@dataclass(frozen=True)
class Arguments:
    """A prism from a file, and how to run it."""

    corners: Path
    """CSV: a corner x,y a line, counter-clockwise; a header is allowed."""
    settings: Annotated[Settings, tyro.conf.arg(name="")]
    scale: float = 1.0
    """The file's unit [m]; 0.001 for millimetres."""
    height: float = 0.12
    """[m]"""

    def scene(self) -> hg.Scene:
        """The prism stands with its centroid in the middle."""
        corners = read_corners(self.corners, self.scale)
        middle = centroid(corners)
        if abs(middle).max() <= MOVED:
            corners = corners + middle  # which `centred` takes away again
        else:
            x, y = 1e3 * middle
            print(f"{self.corners}: the outline's centroid, ({x:.1f}, {y:.1f}) mm, is the origin")
        return hg.Scene(robot="wam_bhand", object=hg.Prism.centred(corners, self.height))


if __name__ == "__main__":
    arguments = tyro.cli(Arguments, prog="hqp-grasp run prism", description=__doc__)
    main(f"prism-{arguments.corners.stem}", arguments.scene, arguments.settings)
