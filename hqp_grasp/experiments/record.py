"""What a trial leaves behind: one row a probe, columns with units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hqp_grasp.errors import SingularTaskError, one_of
from hqp_grasp.grasp import BEYOND, Grasp, Missed
from hqp_grasp.hierarchy.level import Solution
from hqp_grasp.mechanics import SECURE, friction_demand
from hqp_grasp.tasks import ForceTask, KinematicTask, MomentTask
from hqp_grasp.tasks.stack import Stack, Task
from hqp_grasp.touch.simulated import SimulatedHand
from hqp_grasp.world.robot import Robot

CONVERGED_FORCE = ForceTask.goal  # [N²]
CONVERGED_MOMENT = float(np.sqrt(MomentTask.goal))  # √ε_m [N·m]

LEAN_STEPS = 20  # after which the direction that normals lean towards stands still
PLACES = 6  # decimals of normals that tell two places apart
ALIKE = np.radians(2.0)  # [rad] between the quartiles of leans that are of one wall
LIKE = 2e-3  # [–] sines of leans that differ by less count as the same
# Name, unit and meaning of the columns that every probe fills.
COLUMNS = {
    "eps_f": "N^2: squared net force of unit contact forces",
    "eps_m": "(N m)^2: squared net moment about the contact centroid",
    "eps_k": "rad: mean angle between flexion velocity and normal",
    "eps_k_eq7": "m/rad: sum of eq. 7 over the contacts",
    "goal_f": "N^2: eps_f up to which contacts balance: 1e-3 of three, by their number",
    "goal_m": "(N m)^2: eps_m, likewise: (2e-3)^2 of three, and by their distance beyond 10 cm",
    "friction_demand": "1: least friction coefficient that lets the contacts balance; inf: none",
    "adduction_deg": "deg: the spread joint's angle",
    "elevation_deg": "deg: the palm's approach axis below the horizontal",
    "in_contact": "bool: every finger touches",
    "outcome": "touch, or why the probe missed",
    "other_links": "links beside the fingertips that touch the object",
    "in_transit": "links beside the fingertips that meet the object on the way, fingers open",
    "step_share": "share of the planned step that was taken",
    "reaction": "what the controller did about the misses since the last grasp",
    "planner": "the rule that planned the step",
    "limit_active": "bool: a limit holds the step that led here",
    "limit_violation": "rad: how far the worst joint is outside its range, commanded or reached",
    "hqp_projection_gap": "rad: largest difference of hierarchy and projection, limits inactive",
    "solve_us": "us: solving the hierarchy",
    "method": "the way the solver found the step",
}
# What is, beside what is felt: a physical probe's further columns.
TRUE_COLUMNS = {
    "eps_f_true": "N^2: as eps_f, of the contacts as they are; null where a tip is not in contact",
    "eps_m_true": "(N m)^2: as eps_m, of the contacts as they are",
    "friction_demand_true": "1: as friction_demand, of the contacts as they are",
    "object_moved": "m: the object's middle, since the first touch began",
    "floor_f": "N^2: eps_f that a balanced grasp is felt with, by the sensors' noise, on average",
    "floor_m": "(N m)^2: eps_m, likewise",
    "peak_force": "N: the largest at a fingertip so far, as it is",
    "peak_speed": "share of its limit: the fastest joint so far, as it is",
    "peak_torque": "share of its limit: the largest of any joint so far, as it is",
}
VERDICT_COLUMNS = (  # that verdicts read beside trial, probe and error; the true ones where known
    *("in_contact", "other_links", "limit_violation", "eps_f", "eps_m", "eps_f_true", "eps_m_true"),
    *("friction_demand", "friction_demand_true", "goal_f", "goal_m"),
)
# What these and a study's own columns hold, for whoever reads results: those that all have, and
# those that some have.
ALL_HAVE = {
    **{"trial": "whole numbers", "seed": "whole numbers", "probe": "whole numbers"},
    **{"in_contact": "true or false", "other_links": "texts", "error": "texts"},
    **{"limit_violation": "numbers", "eps_f": "numbers", "eps_m": "numbers"},
}
SOME_HAVE = {name: "numbers" for name in VERDICT_COLUMNS if name not in ALL_HAVE}
BALANCE_COLUMNS = ("eps_f", "eps_m", "goal_f", "goal_m", "floor_f", "floor_m")
# The columns that say the same in every row of a trial.
TRIAL_COLUMNS = {
    "rejected": "starting postures that did not touch",
    "error": "what ended the trial, kind and message; null where nothing did",
    "unbalanced": "why no balanced grasp is felt at the end; null where one is",
}
# The columns of each law, by its name: error_force, status_force, rank_force.
LAW_COLUMNS = {
    "error": "unit of the law: Euclidean norm of its error",
    "status": "met or nearest: how the law's level came out in the step that led here",
    "rank": "rank of the law's level in the freedom left to it, in the step that led here",
}
# The columns of each contact point, counted from 1: contact_1_x, contact_1_nx.
CONTACT_COLUMNS = {
    **{axis: f"m: {axis} of the contact, world" for axis in "xyz"},
    **{f"n{axis}": f"{axis} of the object's outward unit normal, world" for axis in "xyz"},
}
JOINT_COLUMN = "rad: joint angle"
# "good", and what keeps a trial from being so, the gravest first.
VERDICTS = ("good", "error", "lost", "not balanced", "link inside", "violation")
TEXTS = {
    "unbalanced",
    "outcome",
    "other_links",
    "in_transit",
    "method",
    "error",
    "reaction",
    "planner",
}


@dataclass(frozen=True, eq=False, repr=False)
class Record:
    """What one trial brought: probes + 1 rows, the first being the first touch.

    A row has the COLUMNS, those of the stack's laws (LAW_COLUMNS), of the robot's contact points
    (CONTACT_COLUMNS) and joints (`q_` and the joint's name); None where there is nothing.
    """

    seed: tuple[int, ...]
    rows: tuple[dict[str, object], ...]
    grasps: tuple[Grasp, ...]  # every grasp felt, in order
    rejected: int  # starting postures drawn before that could not touch
    joints: tuple[str, ...]
    error: str | None = None  # what ended the trial, kind and message: "SolverError: …"

    def __repr__(self) -> str:
        if self.error is not None:
            end = f"ended by {self.error}"
        elif self.lost:
            end = "lost"
        elif self.converged_at is None:
            end = "not converged"
        else:
            end = f"converged at probe {self.converged_at}"
        return f"<Record of seed {self.seed}: {len(self.rows)} rows, {end}>"

    def column(self, name: str) -> np.ndarray:
        """One column over the probes; NaN where a number is missing, None where a text is."""
        one_of("column", name, self.rows[0])
        values = [row[name] for row in self.rows]
        if _kind(name) == pa.string():
            return np.array(values, dtype=object)
        return np.array([np.nan if value is None else value for value in values])

    @property
    def lost(self) -> bool:
        """True where the trial ended without contact."""
        return not self.rows[-1]["in_contact"]

    @property
    def converged_at(self) -> int | None:
        """First probe from which the grasp is felt to be balanced, to the end; see `balanced`."""
        names = [name for name in BALANCE_COLUMNS if name in self.rows[0]]
        bad = ~balanced({name: self.column(name) for name in names})
        last = int(np.flatnonzero(bad)[-1]) if bad.any() else -1
        return None if last == len(bad) - 1 else last + 1

    @property
    def unbalanced(self) -> str | None:
        """Why no balanced grasp is felt at the end, in one line; None where one is."""
        if self.converged_at is not None or not self.grasps:
            return None  # balanced; or lost from the start
        n = np.concatenate([grasp.normals for grasp in self.grasps])
        most, lean, least = _leans(np.unique(n.round(PLACES), axis=0))  # a grasp that is kept, once
        alike = most - least <= ALIKE and least > 0.0
        end = self.grasps[-1]
        if alike and (end.k * np.sin(least)) ** 2 > ForceTask().goal_at(end):
            about = np.degrees(lean)
            return f"walls lean by about {about:.0f}°: equal forces cannot balance"
        if self.lost:
            return "the object is not touched at the end"
        force = float(self.rows[-1]["eps_f"])  # type: ignore[arg-type]
        what = "forces" if force > ForceTask().goal_at(end) else "moments"
        return f"no grasp was found whose {what} balance"

    @property
    def secure(self) -> bool:
        """Whether the grasp at the end needs a friction of SECURE at most; see `secures`."""
        return secures(self.verdict_table())[0]

    @property
    def verdict(self) -> str:
        """What became of the trial, one of VERDICTS; see `verdicts`."""
        return verdicts(self.verdict_table())[0]

    def verdict_table(self) -> pa.Table:
        """The columns that `verdicts` and `secures` read, as of trial 0."""
        there = [name for name in VERDICT_COLUMNS if name in self.rows[0]]
        rows = [
            {"trial": 0, "probe": i, "error": self.error} | {name: row[name] for name in there}
            for i, row in enumerate(self.rows)
        ]
        return pa.Table.from_pylist(rows)

    def to_table(self) -> pa.Table:
        """One row a probe; unit and meaning of a column stand in its field's metadata."""
        count = len(self.rows)
        values: dict[str, list[object]] = {
            "probe": list(range(count)),
            "rejected": [self.rejected] * count,
            "error": [self.error] * count,
            "unbalanced": [self.unbalanced] * count,
        }
        values |= {name: [row[name] for row in self.rows] for name in self.rows[0]}
        meanings = {"probe": "0 is the first touch", **TRIAL_COLUMNS}
        fields = [
            pa.field(name, _kind(name), metadata={"meaning": meanings.get(name) or meaning(name)})
            for name in values
        ]
        return pa.table(values, schema=pa.schema(fields))

    def to_pandas(self) -> Any:
        """The same as a pandas.DataFrame; pandas is no dependency of hqp_grasp."""
        try:
            import pandas  # noqa: F401
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "Record.to_pandas needs pandas: pip install pandas; "
                "Record.to_table() is the same as an arrow table"
            ) from error
        return self.to_table().to_pandas()


def balanced(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rows (r,) in which the grasp is felt to be balanced, from their BALANCE_COLUMNS.

    ε_f ≤ goal_f and ε_m ≤ goal_m; where the sensors' noise has a floor, BEYOND times that where it
    is more: below, nothing can be told from balance. Rows without a goal have that of three
    contacts.
    """
    good = np.ones(len(columns["eps_f"]), dtype=bool)
    for law, goal in (("f", CONVERGED_FORCE), ("m", CONVERGED_MOMENT**2)):
        eps = columns[f"eps_{law}"].astype(float)
        limit = np.full(len(eps), goal)
        if f"goal_{law}" in columns:
            told = columns[f"goal_{law}"].astype(float)
            limit = np.where(np.isnan(told), limit, told)
        if f"floor_{law}" in columns:  # a geometric probe's has none
            limit = np.fmax(limit, BEYOND * columns[f"floor_{law}"].astype(float))
        good &= eps <= limit  # NaN: not
    return good


def _leans(normals: np.ndarray) -> np.ndarray:
    """By what angles [rad] the normals (m, 3) lean: a quarter by more, a half, three quarters (3,).

    All towards one direction, that in which they differ least, as on a cone: those of an edge or
    an end, being far from the others, count the less for it.
    """
    weight = np.ones(len(normals))
    for _ in range(LEAN_STEPS):
        away = normals - weight @ normals / weight.sum()
        axis = np.linalg.eigh((weight[:, None] * away).T @ away)[1][:, 0]
        sines = normals @ axis
        middle = np.median(sines)
        weight = 1.0 / np.maximum(np.abs(sines - middle), LIKE)
    sines = np.clip(sines * np.copysign(1.0, middle), -1.0, 1.0)
    return np.arcsin(np.quantile(sines, [0.75, 0.5, 0.25]))


def meaning(column: str) -> str:
    """Unit and meaning of a column that a probe fills."""
    if column in COLUMNS | TRUE_COLUMNS:
        return (COLUMNS | TRUE_COLUMNS)[column]
    head, _, rest = column.partition("_")
    if head == "q":
        return JOINT_COLUMN
    if head == "contact":
        return CONTACT_COLUMNS[rest.partition("_")[2]]
    return LAW_COLUMNS[head]


def _kind(column: str) -> pa.DataType:
    if column in TEXTS or column.startswith("status_"):
        return pa.string()
    if column in ("probe", "rejected") or column.startswith("rank_"):
        return pa.int64()
    return pa.bool_() if meaning(column).startswith("bool") else pa.float64()


def kind_and_message(error: Exception) -> str:
    """What ended a trial, in one line: "SolverError: no method found an answer"."""
    notes = getattr(error, "__notes__", [])
    return " ".join(f"{type(error).__name__}: {'; '.join([str(error), *notes])}".split())


def empty_row(robot: Robot, stack: Stack, solution: Solution | None = None) -> dict[str, object]:
    """Every column of a probe that felt nothing; `solution`, where a step led to it."""
    points, joints = robot.description.contact_points, robot.joints
    names = [f"contact_{i + 1}_{c}" for i in range(len(points)) for c in CONTACT_COLUMNS]
    names += [f"q_{joint}" for joint in joints]
    nothing = {
        "in_contact": False,
        "limit_active": False,
        "limit_violation": 0.0,
        "other_links": "",
    }
    laws = law_columns(stack, None, solution)
    return dict.fromkeys(COLUMNS) | nothing | laws | dict.fromkeys(names)


def felt_row(
    robot: Robot, stack: Stack, grasp: Grasp, solution: Solution | None = None
) -> dict[str, object]:
    """The columns that a grasp fills, and the laws' levels in the step that led there."""
    spread = robot.groups[0].adduction
    angle = None if spread is None else float(np.degrees(grasp.q[spread]))
    row = empty_row(robot, stack) | {
        "eps_f": ForceTask().potential(grasp),
        "eps_m": MomentTask().potential(grasp),
        "goal_f": ForceTask().goal_at(grasp),
        "goal_m": MomentTask().goal_at(grasp),
        "eps_k": _kinematic(grasp, "angle", np.mean),
        "eps_k_eq7": _kinematic(grasp, "eq7", np.sum),
        "friction_demand": friction_demand(grasp.positions, grasp.normals),
        "adduction_deg": angle,
        "elevation_deg": _elevation(robot.palm(grasp.q)[1]),
        "in_contact": True,
        "outcome": "touch",
        "other_links": ", ".join(grasp.other_links),
        "limit_violation": robot.violation(grasp.q),
    }
    row |= law_columns(stack, grasp, solution)
    points = [point.name for point in robot.description.contact_points]
    for i, contact in enumerate(grasp.contacts):
        if contact.name in points:
            i = points.index(contact.name)
        if i < len(points):
            numbers = [*contact.position.tolist(), *contact.normal.tolist()]
            row |= {
                f"contact_{i + 1}_{column}": number
                for column, number in zip(CONTACT_COLUMNS, numbers, strict=True)
            }
    return row | {f"q_{joint}": float(q) for joint, q in zip(robot.joints, grasp.q, strict=True)}


def _elevation(R_palm: np.ndarray) -> float:
    """Angle of the palm's approach axis below the horizontal [deg]."""
    return float(np.degrees(np.arcsin(np.clip(-R_palm[2, 2], -1.0, 1.0))))


def _kinematic(
    grasp: Grasp, error: str, of: Callable[[np.ndarray], np.floating[Any]]
) -> float | None:
    """Mean or sum of the law's errors, None where flexions do not tell: the stack may lack it."""
    if not all(contact.flexion for contact in grasp.contacts):
        return None
    try:
        return float(of(KinematicTask(error=error).error(grasp)))
    except SingularTaskError:
        return None


def true_columns(
    hand: SimulatedHand | None = None, felt: Grasp | Missed | None = None
) -> dict[str, object]:
    """TRUE_COLUMNS, and the links in the object as they are; None where nothing is known."""
    row: dict[str, object] = dict.fromkeys(TRUE_COLUMNS)
    if hand is None:
        return row
    truth = hand.truth()
    if isinstance(felt, Grasp):
        row["floor_f"], row["floor_m"] = felt.floor
    return (row | true_errors(truth.grasp)) | {
        "object_moved": truth.moved,
        "other_links": ", ".join(truth.other_links),
        "peak_force": hand.worst["force [N]"],
        "peak_speed": hand.worst["speed share"],
        "peak_torque": hand.worst["torque share"],
    }


def true_errors(grasp: Grasp | None) -> dict[str, object]:
    """What the errors of a grasp are, as it is; None where a tip does not touch."""
    if grasp is None:
        return dict.fromkeys(("eps_f_true", "eps_m_true", "friction_demand_true"))
    return {
        "eps_f_true": ForceTask().potential(grasp),
        "eps_m_true": MomentTask().potential(grasp),
        "friction_demand_true": friction_demand(grasp.positions, grasp.normals),
    }


def law_columns(stack: Stack, grasp: Grasp | None, solution: Solution | None) -> dict[str, object]:
    """LAW_COLUMNS of each law: its error at `grasp`, its level in the step that led there.

    Laws at one priority share a level, and so its status and rank. Where a form of stepping has
    no level for a law ("paper" composes force and moment into one step), both are None; and so is
    the error where the law is undefined at this grasp.
    """
    found = () if solution is None else solution.levels
    levels = {level.name.removesuffix(", damped"): level for level in found}
    row: dict[str, object] = {}
    for tasks in stack.priorities:
        level = levels.get(" + ".join(task.name for task in tasks))
        for task in tasks:
            row[f"error_{task.name}"] = _norm(task, grasp)
            row[f"status_{task.name}"] = None if level is None else level.status
            row[f"rank_{task.name}"] = None if level is None else level.rank
    return row


def _norm(task: Task, grasp: Grasp | None) -> float | None:
    """‖e‖ of a law, None without a grasp, and where the law is undefined there."""
    if grasp is None:
        return None
    try:
        return float(np.linalg.norm(Stack.of(task).errors(grasp)[task.name]))
    except SingularTaskError:
        return None


def verdicts(table: pa.Table) -> dict[int, str]:
    """What became of each trial, one of VERDICTS.

    Good: ε_f ≤ goal_f and ε_m ≤ goal_m (the true ones, where they differ from what was felt) from
    some probe to the last, no link but the contact points in the object at any probe from 1 on, no
    violation of a limit, no error.
    """
    rows = in_order(table)
    begin, last = ends(rows)
    error, lost, link, violation = _faults(rows, begin, last)
    unbalanced = ~truly_balanced(rows)[last]
    gravest = np.select((error, lost, unbalanced, link, violation), range(1, len(VERDICTS)), 0)
    trial = rows["trial"].to_numpy()[begin]
    return {int(i): VERDICTS[kind] for i, kind in zip(trial, gravest, strict=True)}


def truly_balanced(table: pa.Table) -> np.ndarray:
    """Rows (r,) in which the grasp, as it is where that differs from what was felt, balances."""
    columns = {name: known(table, name) for name in ("eps_f", "eps_m")}
    for name in ("goal_f", "goal_m"):
        if name in table.column_names:
            columns[name] = floats(table, name)
    return balanced(columns)


def secures(table: pa.Table, demand: float = SECURE) -> dict[int, bool]:
    """Whether each trial ends secure: in a grasp that holds with a friction of `demand`.

    The friction demand (the true one, where it differs from what was felt) is that at the last
    touch; no link is in the object, no limit violated, and there is no error, as for `verdicts`.
    """
    rows = in_order(table)
    begin, last = ends(rows)
    found = known(rows, "friction_demand")[last] <= demand  # NaN: not
    found &= ~np.logical_or.reduce(_faults(rows, begin, last))
    trial = rows["trial"].to_numpy()[begin]
    return {int(i): bool(secure) for i, secure in zip(trial, found, strict=True)}


def _faults(rows: pa.Table, begin: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of each trial: an error, lost, a link inside, a violation."""
    inside = says_something(rows, "other_links") & (rows["probe"].to_numpy() > 0)
    return (
        np.logical_or.reduceat(says_something(rows, "error"), begin),
        ~rows["in_contact"].to_numpy()[last],
        np.logical_or.reduceat(inside, begin),
        np.logical_or.reduceat(floats(rows, "limit_violation") > 0.0, begin),
    )


def ends(rows: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """First and last row of each trial of a table in order."""
    trial = rows["trial"].to_numpy()
    begin = np.flatnonzero(np.diff(trial, prepend=np.nan))
    return begin, np.append(begin[1:], len(trial)) - 1


def known(rows: pa.Table, name: str) -> np.ndarray:
    """A column of numbers as it is, where that is known beside what is felt."""
    return floats(rows, f"{name}_true" if f"{name}_true" in rows.column_names else name)


def holds(demand: float) -> str:
    """What a friction demand means to whoever holds the object."""
    return f"holds if µ ≥ {demand:.2f}" if np.isfinite(demand) else "no friction holds it"


def in_order(table: pa.Table) -> pa.Table:
    """The table by trial and probe, as a study writes it."""
    trial, probe = (table[name].to_numpy() for name in ("trial", "probe"))
    step = np.diff(trial)
    if ((step > 0) | ((step == 0) & (np.diff(probe) > 0))).all():
        return table
    return table.take(np.lexsort((probe, trial)))


def floats(table: pa.Table, name: str) -> np.ndarray:
    """A column of numbers, NaN where one is missing."""
    return table[name].to_numpy().astype(float)


def says_something(table: pa.Table, name: str) -> np.ndarray:
    """Where a column of texts has one that is not empty."""
    texts = pc.fill_null(table[name].cast(pa.string()), "")
    return pc.not_equal(texts, "").to_numpy()
