"""The command line of the package: hqp-grasp COMMAND; --help lists the commands."""

from __future__ import annotations

import pkgutil
import runpy
import sys
from pathlib import Path

from tyro.conf import Positional
from tyro.extras import SubcommandApp

import hqp_grasp.scenarios
from hqp_grasp import __version__
from hqp_grasp.errors import HqpGraspError, one_of
from hqp_grasp.experiments import doctor as health
from hqp_grasp.experiments import picking
from hqp_grasp.experiments import report as reports
from hqp_grasp.experiments.judging import Judging, judge_folder, summary
from hqp_grasp.experiments.plain import speak_plainly
from hqp_grasp.experiments.robot_check import check
from hqp_grasp.experiments.view import HOST, PORT, serve
from hqp_grasp.judge.judge import Judge
from hqp_grasp.world.description import MODELS
from hqp_grasp.world.draft import write_draft
from hqp_grasp.world.scene import Scene

app = SubcommandApp()


@app.command
def run(scenario: Positional[str], /) -> None:
    """Run a scenario; the rest are its own arguments: `run cylinder --help` lists them.

    Args:
        scenario: cylinder, cylinder_65, hexagon, irregular, drum, box, beam, prism or object.
    """
    runpy.run_module(f"hqp_grasp.scenarios.{_scenario(scenario)}", run_name="__main__")


@app.command
def pick(scenario: Positional[str], /) -> None:
    """Find an object by touch, hold, lift, shake and set it down: `pick cylinder --help`.

    Takes the scenario's own arguments, and the object's mass, the strength of the grip, the
    friction believed in. Writes DIR/picks.parquet, one row a trial.

    Args:
        scenario: cylinder, cylinder_65, hexagon, irregular, drum, box, beam, prism or object.
    """
    picking.main(_scenario(scenario))


def _scenario(name: str) -> str:
    names = sorted(module.name for module in pkgutil.iter_modules(hqp_grasp.scenarios.__path__))
    return one_of("scenario", name, names)


@app.command
def report(folders: Positional[tuple[Path, ...]], /) -> None:
    """Print what became of the trials of results folders, and compare them in pairs.

    Args:
        folders: Where scenarios left their results.
    """
    print(reports.report(folders))


@app.command
def judge(
    folder: Positional[Path],
    /,
    squeeze: tuple[str, ...] = ("hierarchy",),
    protocol: tuple[str, ...] = ("pulls",),
    force: float = 5.0,
    mass: float = 0.1,
    friction: float = 0.6,
    believed: float = 0.5,
    probe: int | None = None,
    jobs: int = 2,
    cluster: str | None = None,
) -> None:
    """Judge the grasps of a results folder: free the object, squeeze, lift, pull until it slips.

    Writes DIR/judged.parquet, one row for each trial, squeeze and protocol.

    Args:
        folder: Where a scenario left its results.
        squeeze: How the fingers press: hierarchy, equal-torque, equal-normal, null-space.
        protocol: pulls (lift, then forces and torques along each axis that grow until the object
            slips), dexgraspbench (six pulls of 10 m/s^2 times the mass, without gravity).
        force: Mean normal force of a contact [N].
        mass: The object's [kg].
        friction: The object's.
        believed: Friction that the hierarchy of forces counts on.
        probe: The touch to judge, 0 being the first; default: the last of each trial.
        jobs: Processes.
        cluster: Judge on a Dask cluster instead: the address of its scheduler.
    """
    scene = Scene.load(folder / "scene.json")
    judges = [
        Judge(scene, how, force, mass, friction, believed, by) for how in squeeze for by in protocol
    ]
    print(summary(judge_folder(folder, judges, probe, jobs, cluster)))
    print(f"\njudged   {folder / Judging.file}")


@app.command
def view(
    folder: Positional[Path],
    /,
    compare: Path | None = None,
    trial: int | None = None,
    host: str = HOST,
    port: int = PORT,
) -> None:
    """Show a results folder in the browser: any trial, any probe, failures by kind.

    Args:
        folder: Where a scenario left its results.
        compare: A second folder of the same seed, whose robot is drawn beside as a ghost.
        trial: The trial to show first, at its end.
        host: Address to listen on; other machines can look on where it is not the loopback.
        port: Port to listen on; 0 takes any free one.
    """
    serve(folder, compare, trial, host, port)


@app.command
def robot(
    path: Positional[str],
    /,
    hand: str | None = None,
    picture: Path | None = None,
) -> None:
    """Say how a robot was understood: joints, couplings, closing, palm, self-collisions.

    Of a model alone, .xml or .urdf, a first description is written beside it, to be corrected.

    Args:
        path: A robot of this package by name, or a folder with a robot.toml, or such a file; or
            a model.
        hand: The hand that grasps, of a robot with several.
        picture: File to draw it into.
    """
    if Path(path).suffix.lower() in MODELS:
        path = str(write_draft(Path(path)))
        print(f"wrote    {path}, a first description: read it, and correct what is wrong\n")
    print(check(path, hand, picture))


@app.command
def doctor() -> None:
    """Say what of hqp_grasp works on this machine: versions, extras, solver, browser, renderer."""
    print(health.doctor())


def main() -> None:
    """Run the command that the arguments name; what is wrong is said in one line."""
    speak_plainly()
    if sys.argv[1:] == ["--version"]:
        print(f"hqp_grasp {__version__}")
        return
    try:
        command = {"run": run, "pick": pick}.get("".join(sys.argv[1:2]))
        if command and len(sys.argv) > 2 and not sys.argv[2].startswith("-"):
            name = sys.argv[2]
            sys.argv[1:3] = []  # the scenario reads the rest
            command(name)
        else:
            app.cli(prog="hqp-grasp", description=f"hqp_grasp {__version__}: grasping by touch.")
    except HqpGraspError as error:
        sys.exit(f"hqp_grasp: {error}")


if __name__ == "__main__":
    main()
