"""An object read from a file, an MJCF or a mesh: no Python needed.

hqp-grasp run object --object FILE --stack fmk --trials 40 --probes 40 --seed 0 --jobs 2
"""

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import Settings, main


@dataclass(frozen=True)
class Arguments:
    """An object from a file, and how to run it."""

    object: Path
    """MJCF with one object of convex geoms, or a closed mesh (.obj, .stl); z is up. A path, or
    package:path in an installed package."""
    settings: Annotated[Settings, tyro.conf.arg(name="")]
    scale: float = 1.0
    """The file's unit [m]; 0.001 for millimetres."""

    def scene(self) -> hg.Scene:
        """The object stands as in its file, its middle where the hand expects it."""
        with warnings.catch_warnings(record=True) as told:
            body = hg.Body(self.object, self.scale)
        for warning in told:
            print(f"warning: {warning.message}", file=sys.stderr)
        return hg.Scene(robot="wam_bhand", object=body)


if __name__ == "__main__":
    arguments = tyro.cli(Arguments, prog="hqp-grasp run object", description=__doc__)
    main(f"object-{arguments.object.stem}", arguments.scene, arguments.settings)
