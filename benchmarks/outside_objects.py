"""Objects that nobody here made: groceries of the robosuite package, felt from random starts.

    python benchmarks/outside_objects.py --trials 100 --seed 60 --pictures docs/images

`make outside` installs the package, without its dependencies. Counts trials by the kinds of
`hqp-grasp report`, and draws the first good grasp of each object.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import mujoco
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

import hqp_grasp as hg
from hqp_grasp.experiments.record import VERDICTS

FOLDER = "robosuite:models/assets/objects"
OBJECTS = ("can", "bottle", "milk", "cereal", "lemon", "bread")


def scene_of(name: str) -> hg.Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of meshes that are not closed: their hull is felt
        return hg.Scene(object=hg.Body(f"{FOLDER}/{name}.xml"))


def one(name: str, form: str, probes: int, seed: int, i: int) -> hg.Record:
    stack = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
    return hg.Trial(scene_of(name), stack, probes, form=form).attempt((seed, i))


def draw(axes: Axes, scene: hg.Scene, name: str, grasp: hg.Grasp) -> None:
    """The object's hull, and forces as arrows where the fingertips touch."""
    model = scene.model
    data = mujoco.MjData(model)
    scene.articulated.place(data, grasp.q)
    geom = model.geom("object")
    mesh = int(geom.dataid[0])
    first, many = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    R, p = data.geom_xmat[geom.id].reshape(3, 3), data.geom_xpos[geom.id]
    x = model.mesh_vert[first : first + many] @ R.T + p
    axes.plot_trisurf(*x.T, triangles=ConvexHull(x).simplices, color="tab:orange", alpha=0.35)
    out = grasp.positions + 0.04 * grasp.normals
    axes.quiver(*out.T, *(-0.04 * grasp.normals).T, color="tab:blue")
    axes.set(title=name, xticks=[], yticks=[], zticks=[])
    axes.set_aspect("equal")


def main(
    trials: int = 100,
    seed: int = 60,
    probes: int = 40,
    form: str = "hierarchy",
    jobs: int = 2,
    pictures: Path | None = None,
) -> None:
    """Print one line an object.

    Args:
        trials: random starts of each
        seed: trial i draws from SeedSequence([seed, i])
        probes: touches after the first
        form: of stepping
        jobs: processes
        pictures: folder for objects.png
    """
    figure = Figure(figsize=(9, 6), layout="constrained")
    FigureCanvasAgg(figure)
    print(f"form {form}, seed {seed}, {trials} trials of {probes} probes\n")
    print(f"{'':8}" + "".join(f"{kind:>14}" for kind in VERDICTS) + f"{'probes, worst':>16}")
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for k, name in enumerate(OBJECTS):
            try:
                scene = scene_of(name)
            except hg.HqpGraspError as error:
                sys.exit(str(error))
            work = partial(one, name, form, probes, seed)
            found = list(pool.map(work, range(trials), chunksize=5))
            count = Counter(record.verdict for record in found)
            good = [record for record in found if record.verdict == "good"]
            at = [record.converged_at for record in good]
            told = f"{np.median(at):g}, {max(at)}" if at else "–"
            print(f"{name:8}" + "".join(f"{count[kind]:14}" for kind in VERDICTS) + f"{told:>16}")
            axes = figure.add_subplot(2, 3, k + 1, projection="3d")
            draw(axes, scene, name, (good or found)[0].grasps[-1])
    if pictures is not None:
        figure.savefig(pictures / "objects.png", dpi=80)


if __name__ == "__main__":
    tyro.cli(main)
