"""What one step costs as joints and contacts grow, part by part.

    python benchmarks/cycle.py --problems 200 --solver active-set

Arms with hands (WAM and BarrettHand) stand around an object, or hands alone where joints are 4 to a
hand. A problem is a posture near home with a ball of 20 cm felt between the fingertips. The laws
are force ▷ moment ▷ posture within caps, ranges and clearances (`MemorylessForm`), and the step is
landed. Medians of CPU time; what the parts do not cover is the rest of the step.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.control import controller, step
from hqp_grasp.control.forms import TOUCH_RANK, MemorylessForm
from hqp_grasp.control.limits import ClearanceLimit
from hqp_grasp.world.robot import compiled

CASES = (  # model of a hand or arm, how many of them, contacts
    ("bhand", 2, 6),
    ("wam_bhand", 1, 3),
    ("wam_bhand", 2, 2),
    ("wam_bhand", 2, 4),
    ("wam_bhand", 2, 6),
    ("wam_bhand", 3, 9),
    ("wam_bhand", 4, 12),
)
BASE = '<mujoco><worldbody><body name="base"/></worldbody></mujoco>'
AROUND = 1.0  # [m] from the arms' bases to the object
NEAR = 0.1  # [rad] of postures from home, standard deviation


def built(kind: str, count: int, contacts: int) -> hg.Robot:
    """`count` arms around an object, the contacts on their first fingertips in turn."""
    folder = Path(hg.__file__).parents[1] / "robots" / kind
    models, home, points = ['[[model]]\nfile = "base.xml"\n'], ["[home]"], []
    for i in range(count):
        turn = 2.0 * np.pi * i / count
        x, y = -AROUND * np.cos(turn), -AROUND * np.sin(turn)
        models.append(
            f'[[model]]\nfile = "{folder / kind}.xml"\nprefix = "r{i}_"\nat = "base"\n'
            f"pos = [{x}, {y}, 0.0]\nrpy = [0.0, 0.0, {turn}]\n"
        )
        arm = {"wam_j2": 0.7, "wam_j4": 1.6} if kind == "wam_bhand" else {}
        fingers = {f"bhand_f{f}_proximal": 0.78 for f in (1, 2, 3)}
        home += [f"r{i}_{joint} = {q}" for joint, q in (arm | fingers).items()]
        for f in range(1, contacts // count + 1):
            points.append(
                f'[[contact_points]]\nname = "r{i}_{f}"\nsite = "r{i}_f{f}_tip_center"\n'
                f'geom = "r{i}_f{f}_tip"\nflexion = ["r{i}_bhand_f{f}_proximal"]\n'
            )
    with tempfile.TemporaryDirectory() as made:
        (Path(made) / "base.xml").write_text(BASE)
        (Path(made) / "robot.toml").write_text("\n".join([*models, *home, *points]))
        about = hg.RobotDescription.load(made)
        return hg.Robot(about, compiled(about))


def felt(robot: hg.Robot, rng: np.random.Generator) -> tuple[np.ndarray, list[hg.Contact]]:
    """A posture near home, and a ball felt by all fingertips."""
    q = robot.home + NEAR * rng.normal(size=robot.n)
    q = np.clip(q, robot.q_lower, robot.q_upper)
    centres = robot.centers(q)
    away = centres - centres.mean(axis=0) + 0.02 * rng.normal(size=centres.shape)
    normals = away / np.linalg.norm(away, axis=1, keepdims=True)
    places = centres - robot.tip_radius[:, None] * normals
    return q, [hg.Contact(x, n) for x, n in zip(places, normals, strict=True)]


def main(problems: int = 200, seed: int = 0, solver: str = "active-set") -> None:
    """Print medians in µs.

    Args:
        problems: grasps of each robot
        seed: draws them
        solver: of the hierarchies
    """
    spent: defaultdict[str, list[float]] = defaultdict(list)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            begin = time.process_time()
            answer = function(*args, **options)
            spent[name].append(time.process_time() - begin)
            return answer

        return call

    hqp = hg.HQP(solver, rank_tolerance=TOUCH_RANK)
    parts = {
        (hg.HQP, "solve"): "hierarchy",
        (ClearanceLimit, "level"): "clearance",
        (hg.Stack, "limit_levels"): "limits",
        (step, "fitting"): "laws",
        (controller, "land"): "landing",
    }
    for (owner, name), part in parts.items():
        setattr(owner, name, timed(part, getattr(owner, name)))
    columns = ("grasp", *dict.fromkeys(parts.values()), "whole step")
    print(f"{problems} grasps each, {solver}; medians [µs], the whole step's 95 % behind")
    print("   n  k  pairs" + "".join(f"{name:>12}" for name in columns) + "    95 %  certified")
    for kind, count, contacts in CASES:
        robot = built(kind, count, contacts)
        stack = hg.ForceTask() >> hg.MomentTask() >> hg.PostureTask(robot.home)
        rule = hg.Controller(robot, stack, MemorylessForm(hqp))
        pairs = sum(len(v._links.pairs) for v in rule.stack.limits if isinstance(v, ClearanceLimit))
        rng = np.random.default_rng(seed)
        certified = 0
        for problem in range(problems + 1):
            q, touched = felt(robot, rng)
            begin = len(spent["hierarchy"])
            grasp = timed("grasp", robot.grasp)(q, touched)
            history = [hg.Touch(q, grasp)]
            found = timed("whole step", rule.step)(history)
            # Of the hierarchies in a step the first is the laws'; those of the landing are its own.
            del spent["hierarchy"][begin + 1 :]
            if problem == 0:  # the first one loads what is compiled
                spent.clear()
                continue
            certified += found.plan.solution.certified
        row = "".join(f"{1e6 * np.median(spent[name]):12.0f}" for name in columns)
        late = 1e6 * np.percentile(spent["whole step"], 95)
        print(f"{robot.n:4}{contacts:3}{pairs:7}{row}{late:8.0f}{certified:6} of {problems}")
        spent.clear()


if __name__ == "__main__":
    tyro.cli(main)
