"""The closed loop of touches: one seed in, one record out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import index
from typing import ClassVar

import numpy as np

from hqp_grasp.control.controller import Controller, Step
from hqp_grasp.control.forms import Form
from hqp_grasp.errors import InputError, ReachError, flag, instance, one_of, whole
from hqp_grasp.experiments.record import (
    Record,
    empty_row,
    felt_row,
    kind_and_message,
    true_columns,
    true_errors,
)
from hqp_grasp.experiments.start import FirstTouch, Start
from hqp_grasp.grasp import Grasp, Missed, Touch
from hqp_grasp.hierarchy.level import Solution
from hqp_grasp.tasks import Stack, Task
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.touch.noisy import Noise, NoisyProbe
from hqp_grasp.touch.physical import PhysicalProbe
from hqp_grasp.touch.probe import Probe
from hqp_grasp.touch.simulated import SimulatedHand
from hqp_grasp.world.imperfections import Imperfections
from hqp_grasp.world.physics import Physics
from hqp_grasp.world.robot import Robot
from hqp_grasp.world.scene import Scene

PRESS = 1.0  # [N] at each fingertip while it feels
MAX_UNHELD = 20  # postures in a row that touch by geometry and not by force
IMPERFECTIONS = 1  # their random numbers are a stream of their own: starts are those without


@dataclass(frozen=True)
class Trial:
    """A scene, a stack of laws, and how to step: run(seed) is a pure function of its seed.

    A random start, then controller and probe in turn: `form` and `landing` are the Controller's.
    `start` draws the first touch, or is a grasp to begin from.
    """

    file: ClassVar[str] = "probes.parquet"  # that a study of it ends in
    scene: Scene
    stack: Stack | Task
    probes: int = 60  # touches after the first
    form: str | Form = "hierarchy"
    landing: bool = True
    links: str = "block"  # or "pass": see GeometricProbe
    probe: str | Physics = "geometric"  # or "physical", which is Physics()
    preset: str | None = None  # of Imperfections, replacing those of `probe`
    noise: Noise | None = None  # on contacts that the geometric probe feels
    start: Start | Grasp = field(default_factory=Start)

    def __post_init__(self) -> None:
        instance("Trial.scene", self.scene, Scene)
        one_of("links", self.links, ("pass", "block"))
        if not isinstance(self.probe, Physics):
            one_of("probe", self.probe, ("geometric", "physical"))
        if self.preset is not None:
            imperfections = Imperfections.preset(self.preset)
            if self.physics is None:
                raise InputError(f"preset {self.preset!r} needs probe='physical'")
            object.__setattr__(self, "probe", replace(self.physics, imperfections=imperfections))
        if not isinstance(self.noise, Noise | None):
            raise InputError(f"Trial.noise must be a Noise, or None; got {self.noise!r}")
        if self.noise is not None and self.physics is not None:
            raise InputError(
                "noise is for probe='geometric'; a simulated hand's sensors have a preset"
            )
        object.__setattr__(self, "probes", whole("probes", self.probes, 1))
        object.__setattr__(self, "landing", flag("landing", self.landing))
        if not isinstance(self.start, Start | Grasp):
            raise InputError(f"Trial.start must be a Start or a Grasp; got {self.start!r}")
        object.__setattr__(self, "stack", Stack.of(self.stack))
        self.controller(self.scene)  # raises for what it cannot compose

    @property
    def physics(self) -> Physics | None:
        """The world of a physical probe, None for a geometric one."""
        if isinstance(self.probe, Physics):
            return self.probe
        return Physics() if self.probe == "physical" else None

    @property
    def true_columns(self) -> dict[str, object]:
        """The columns of what is, beside what is felt; None in each."""
        if self.physics is not None:
            return true_columns()
        return {} if self.noise is None else true_errors(None)

    def controller(self, scene: Scene) -> Controller:
        """The controller of one trial, in the scene where it began."""
        return Controller(scene.articulated, self.stack, self.form, self.probes + 1, self.landing)

    def run(self, seed: int | Sequence[int], probe: Probe | None = None) -> Record:
        """Begin, then step and touch `probes` times, or until the controller gives up.

        Raises what goes wrong on the way; `attempt` keeps what was felt before.
        """
        record, failure = self._run(seed, probe)
        if failure is not None:
            raise failure
        return record

    def attempt(self, seed: int | Sequence[int], probe: Probe | None = None) -> Record:
        """`run`, but a failure on the way becomes `Record.error`: rows so far are kept."""
        return self._run(seed, probe)[0]

    def nothing(self, seed: int | Sequence[int], error: str) -> Record:
        """The record of a trial of which nothing is known but what ended it."""
        robot = self.scene.articulated
        rows = (self._empty(robot, Stack.of(self.stack)),) * (self.probes + 1)
        return Record(entropy_of(seed), rows, (), 0, robot.joints, error)

    def _run(
        self, seed: int | Sequence[int], probe: Probe | None
    ) -> tuple[Record, Exception | None]:
        entropy = entropy_of(seed)
        robot, stack = self.scene.articulated, Stack.of(self.stack)
        rows: list[dict[str, object]] = []
        history: list[Touch] = []
        rejected, failure = 0, None
        # One failing trial must not cost the others of a study: whatever ended this one is told
        # in its record, with the rows so far.
        try:
            began = self.begin(entropy, probe)
            rejected = began.first.rejected
            for row, touch in self.touches(began):
                rows.append(row)
                if touch is not None:
                    history.append(touch)
        except Exception as error:
            failure = error
        rows += [self._empty(robot, stack) for _ in range(self.probes + 1 - len(rows))]
        grasps = tuple(touch.felt for touch in history if isinstance(touch.felt, Grasp))
        ended = None if failure is None else kind_and_message(failure)
        record = Record(entropy, tuple(rows), grasps, rejected, robot.joints, ended)
        return record, failure

    def begin(self, entropy: tuple[int, ...], probe: Probe | None = None) -> Began:
        """The first touch, and the hand that made it."""
        if isinstance(self.start, Grasp):
            return self._touching(FirstTouch(self.scene, self.start, 0), entropy, probe)
        rng = np.random.default_rng(np.random.SeedSequence(entropy))
        if probe is None:
            return self._drawn(self.start, entropy, rng)
        given = probe

        def same(scene: Scene) -> Probe:
            if scene is not self.scene:
                raise InputError(
                    "a hand without an arm is placed by the draw, and a probe of one's own stays "
                    "where it is: begin from a grasp, Trial(start=grasp)"
                )
            return given

        return self._touching(self.start.draw(self.scene, same, rng), entropy, probe)

    def _drawn(self, start: Start, entropy: tuple[int, ...], rng: np.random.Generator) -> Began:
        """A start found by geometry; where a simulated hand cannot hold it, the next one."""
        rejected, last = 0, ""
        physics = self.physics
        if physics is not None and physics.imperfections.faults:  # they come later
            whole = replace(physics, imperfections=replace(physics.imperfections, faults=()))
            first = replace(self, probe=whole, preset=None)._drawn(start, entropy, rng).first
            return self._touching(first, entropy, None)
        for _ in range(MAX_UNHELD):
            first = start.draw(self.scene, lambda scene: GeometricProbe(scene, self.links), rng)
            rejected += first.rejected
            began = self._touching(replace(first, rejected=rejected), entropy, None)
            if began.hand is None or isinstance(began.felt, Grasp):
                return began
            last, rejected = f"{began.felt.reason.value} ({began.felt.where})", rejected + 1
        raise ReachError(
            f"the simulated hand holds none of {MAX_UNHELD} postures that geometry finds "
            f"(the last: {last})"
        )

    def _touching(self, first: FirstTouch, entropy: tuple[int, ...], probe: Probe | None) -> Began:
        hand, touching = self._hand(first, entropy, probe)
        felt: Grasp | Missed = first.grasp
        if isinstance(touching, PhysicalProbe | NoisyProbe):
            felt = touching.touch(first.grasp.q)
        return Began(first, hand, touching, felt)

    def touches(self, began: Began) -> Iterator[tuple[dict[str, object], Touch | None]]:
        """The row of every touch as it is made; the last, without a touch, tells of giving up."""
        scene, hand, touching = began.first.scene, began.hand, began.touching
        robot, controller = scene.articulated, self.controller(scene)
        stack = Stack.of(controller.stack)
        history = [Touch(began.first.grasp.q, began.felt)]
        yield self._row(robot, stack, history[0], None, hand, touching), history[0]
        while len(history) <= self.probes:
            step = controller.step(history)
            if step.q_target is None:
                told = {"outcome": f"gave up: {step.reason}", "reaction": "gave up"}
                yield self._empty(robot, stack) | told, None
                return
            history.append(Touch(step.q_target, _touched(touching, step)))
            row = self._row(robot, stack, history[-1], step.solution, hand, touching)
            yield row | _about(step) | _in_transit(touching, history, step), history[-1]

    def _hand(
        self, first: FirstTouch, entropy: tuple[int, ...], probe: Probe | None
    ) -> tuple[SimulatedHand | None, Probe]:
        """The simulated hand, if any, and the probe that touches."""
        physics, robot = self.physics, first.scene.articulated
        rng = np.random.default_rng(np.random.SeedSequence([*entropy, IMPERFECTIONS]))
        if probe is not None or physics is None:
            probe = probe or GeometricProbe(first.scene, self.links)
            return None, probe if self.noise is None else NoisyProbe(probe, robot, self.noise, rng)
        hand = SimulatedHand(first.scene, physics, self.links, rng)
        hand.place(first.grasp.q)
        return hand, PhysicalProbe(hand, robot, PRESS, hand.table)

    def _empty(
        self, robot: Robot, stack: Stack, solution: Solution | None = None
    ) -> dict[str, object]:
        return empty_row(robot, stack, solution) | self.true_columns

    def _row(
        self,
        robot: Robot,
        stack: Stack,
        touch: Touch,
        solution: Solution | None,
        hand: SimulatedHand | None,
        probe: Probe,
    ) -> dict[str, object]:
        felt, worst = touch.felt, robot.violation(touch.q_target)
        row = self._empty(robot, stack, solution)
        if isinstance(felt, Missed):
            row["outcome"] = f"{felt.reason.value} ({felt.where})"
        else:
            row |= felt_row(robot, stack, felt, solution)
            worst = max(worst, robot.violation(felt.q))
        if hand is not None:
            worst = max(worst, hand.worst["range [rad]"])
            row |= true_columns(hand, felt)
        if isinstance(probe, NoisyProbe):
            true = probe.felt[-1]
            row |= true_errors(true if isinstance(true, Grasp) else None)
        row["limit_violation"] = worst
        return row


@dataclass(frozen=True, eq=False)
class Began:
    """A trial after its first touch."""

    first: FirstTouch
    hand: SimulatedHand | None  # of a physical probe
    touching: Probe
    felt: Grasp | Missed  # by that probe


def _in_transit(probe: Probe, history: Sequence[Touch], step: Step) -> dict[str, object]:
    """The column of what the move that a step asked for meets, where geometry can tell."""
    probe = probe.probe if isinstance(probe, NoisyProbe) else probe
    if not isinstance(probe, GeometricProbe) or step.q_target is None:
        return {}
    before = history[-2]
    start = before.felt.q if isinstance(before.felt, Grasp) else before.q_target
    return {"in_transit": ", ".join(probe.in_transit([start, *step.via, step.q_target]))}


def _touched(probe: Probe, step: Step) -> Grasp | Missed:
    """What the probe feels at the step's target; a hand that moves passes the step's way first."""
    if isinstance(probe, PhysicalProbe):
        return probe.touch(step.q_target, step.via)  # type: ignore[arg-type]
    return probe.touch(step.q_target)  # type: ignore[arg-type]


def _about(step: Step) -> dict[str, object]:
    """The columns that the step towards a touch fills."""
    plan = step.plan
    if plan is None:
        return {}
    return {
        "step_share": step.share,
        "reaction": step.reason or None,
        "planner": plan.planner or None,
        "limit_active": plan.limit_active,
        "hqp_projection_gap": plan.gap,
        "solve_us": plan.solve_us,
        "method": plan.solution.method,
    }


def entropy_of(seed: int | Sequence[int]) -> tuple[int, ...]:
    """The whole numbers that seed a trial; raise InputError for what is none."""
    numbers: Sequence[int] = seed if isinstance(seed, Sequence) else (seed,)
    try:
        entropy = tuple(index(number) for number in numbers)
    except TypeError as error:
        raise InputError(f"a seed is a whole number, or several; got {seed!r}") from error
    if not entropy or min(entropy) < 0:
        raise InputError(f"a seed must be at least 0; got {seed!r}")
    return entropy
