"""Questions answered from results: what became of a study's trials, and of several side by side."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.parts import read_results
from hqp_grasp.experiments.record import (
    ALL_HAVE,
    SOME_HAVE,
    VERDICTS,
    ends,
    floats,
    in_order,
    known,
    secures,
    truly_balanced,
    verdicts,
)
from hqp_grasp.mechanics import SECURE

Z = 1.96  # standard deviations of a 95 % interval
SHOWN = 5  # trials named of each kind of failure


@dataclass(frozen=True)
class Outcome:
    """What became of one trial."""

    seed: int
    trial: int
    verdict: str  # one of VERDICTS
    balanced_at: int | None  # first probe from which force and moment stay balanced
    adduction: float  # [deg] at the last touch; NaN where there is none
    secure: bool | None  # at the end; see `secures`. None in a folder from before friction demands
    secure_at: int | None  # first probe whose grasp needs a friction of SECURE at most
    secure_since: int | None  # probe from which every grasp does, to the end


def outcomes(folder: str | Path) -> list[Outcome]:
    """Every trial of a results folder, in order; raise ResultsError where there is none."""
    path = Path(folder) / "probes.parquet"
    if not path.exists():
        raise ResultsError(f"{folder} has no probes.parquet: it is no results folder")
    needed = ALL_HAVE | {"adduction_deg": "numbers"}
    try:
        table = in_order(read_results(path, needed, SOME_HAVE))
    except ResultsError as error:
        raise ResultsError(f"{path} is broken ({error}); run its scenario again") from error
    verdict, secure = verdicts(table), {}
    demand = np.full(len(table), np.nan)
    if "friction_demand" in table.column_names:
        secure, demand = secures(table), known(table, "friction_demand")
    trial, seed = (table[name].to_numpy() for name in ("trial", "seed"))
    adduction = floats(table, "adduction_deg")
    begin, end = ends(table)
    row = np.arange(len(trial))
    balanced = truly_balanced(table)
    touch = np.maximum.reduceat(np.where(table["in_contact"].to_numpy(), row, -1), begin)
    holding = demand <= SECURE
    found = np.minimum.reduceat(np.where(holding, row, len(row)), begin)
    return [
        Outcome(
            int(seed[first]),
            int(trial[first]),
            verdict[int(trial[first])],
            _probe(since - first, last - first),
            float(adduction[at]) if at >= 0 else math.nan,
            secure.get(int(trial[first])),
            _probe(reached - first, last - first),
            _probe(kept - first, last - first),
        )
        for first, last, at, since, reached, kept in zip(
            begin, end, touch, _stays(balanced, begin), found, _stays(holding, begin), strict=True
        )
    ]


def _stays(holds: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """The row of each trial from which `holds` is true to its end; the one after it: none."""
    broken = np.maximum.reduceat(np.where(holds, -1, np.arange(len(holds))), begin)
    return np.asarray(np.maximum(broken + 1, begin))


def _probe(probe: int, last: int) -> int | None:
    return int(probe) if probe <= last else None


def interval(count: int, total: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson 1927)."""
    share = count / total
    middle = (share + Z**2 / (2 * total)) / (1 + Z**2 / total)
    half = Z * math.sqrt(share * (1 - share) / total + Z**2 / (4 * total**2)) / (1 + Z**2 / total)
    return max(0.0, middle - half), min(1.0, middle + half)


def paired_difference(one: Sequence[bool], other: Sequence[bool]) -> tuple[float, float, float]:
    """How much larger the share of `other` is than that of `one`, and its 95 % interval.

    The same trials, pair by pair, with Agresti and Min's adjustment (2005): half a pair more in
    each cell, so that agreement throughout has a width too.
    """
    n = len(one) + 2
    better = sum(b and not a for a, b in zip(one, other, strict=True)) + 0.5
    worse = sum(a and not b for a, b in zip(one, other, strict=True)) + 0.5
    difference = (better - worse) / n
    half = Z * math.sqrt(better + worse - (better - worse) ** 2 / n) / n
    low, high = max(-1.0, difference - half), min(1.0, difference + half)
    return (sum(other) - sum(one)) / len(one), low, high


def report(folders: Sequence[str | Path]) -> str:
    """The table of each study, the trials that failed, and each two studies compared in pairs."""
    if not folders:
        raise InputError("a report needs at least one results folder")
    studies = {str(folder): outcomes(folder) for folder in folders}
    width = max(len(name) for name in studies)
    heads = (*VERDICTS[1:], "probes to balance", "adduction at the end")
    shares = f"{'good [95 %]':>21}  {'secure [95 %]':>21}"
    rows = [f"{'':{width}}  {'trials':>6}  {shares}" + _cells(heads)]
    for name, found in studies.items():
        count = Counter(outcome.verdict for outcome in found)
        good = _share(count["good"], len(found))
        ends_so = [outcome.secure for outcome in found if outcome.secure is not None]
        secure = _share(sum(ends_so), len(ends_so)) if ends_so else "–"
        at = [outcome.balanced_at for outcome in found if outcome.balanced_at is not None]
        angles = [o.adduction for o in found if o.verdict == "good" and math.isfinite(o.adduction)]
        angle = f"{np.mean(angles):.1f} ± {np.std(angles):.1f}°" if angles else "–"
        cells = (*(str(count[kind]) for kind in VERDICTS[1:]), _probes(at), angle)
        rows.append(
            f"{name:{width}}  {len(found):>6}  {good:>21}  {secure:>21}" + _cells(cells, heads)
        )
    rows.append(f"secure: a friction of {SECURE:g} holds what the trial ends in")
    for name, found in studies.items():
        if found[0].secure is None:
            continue
        at = [outcome.secure_at for outcome in found if outcome.secure_at is not None]
        since = [outcome.secure_since for outcome in found if outcome.secure_since is not None]
        lost = _share(sum(o.secure_at is not None and not o.secure for o in found), len(found))
        rows.append(
            f"{name}: secure once {_share(len(at), len(found))}, first at probe {_probes(at)}, "
            f"to the end from {_probes(since)}; once and not at the end {lost}"
        )
    rows.append("probes: median (99th percentile, worst)")
    for one, other in combinations(studies, 2):
        rows.append(_compared(one, other, studies[one], studies[other]))
    for name, found in studies.items():
        for kind in VERDICTS[1:]:
            failed = [o for o in found if o.verdict == kind]
            for outcome in failed[:SHOWN]:
                rows.append(
                    f"{kind}: trial {outcome.trial} of seed {outcome.seed}: "
                    f"hqp-grasp view {name} --trial {outcome.trial}"
                )
            if len(failed) > SHOWN:
                rest = ", ".join(str(outcome.trial) for outcome in failed[SHOWN:])
                rows.append(f"{kind}: and trials {rest}")
    return "\n".join(rows)


def _share(count: int, total: int) -> str:
    """A count, and Wilson's interval of its share."""
    low, high = interval(count, total)
    return f"{count} [{low:.1%}, {high:.1%}]"


def _probes(at: Sequence[int]) -> str:
    """Median, 99th percentile and worst of the probes at which something came."""
    if not at:
        return "–"
    median, late = np.percentile(at, [50, 99])
    return f"{median:g} ({late:g}, {max(at)})"


def _compared(one: str, other: str, first: list[Outcome], second: list[Outcome]) -> str:
    """One line on the trials that two studies share by seed and number."""
    there = {(o.seed, o.trial): o.verdict == "good" for o in second}
    shared = [o for o in first if (o.seed, o.trial) in there]
    if not shared:
        return f"{other} against {one}: no trial of the same seed"
    pairs = [(o.verdict == "good", there[o.seed, o.trial]) for o in shared]
    difference, low, high = paired_difference(*zip(*pairs, strict=True))
    return (
        f"{other} against {one}, {len(shared)} pairs: good {difference:+.1%} "
        f"[{low:+.1%}, {high:+.1%}]"
    )


def _cells(texts: Sequence[str], heads: Sequence[str] | None = None) -> str:
    """Texts right-aligned below their heads."""
    widths = [len(head) for head in (heads or texts)]
    return "".join(f"  {text:>{width}}" for text, width in zip(texts, widths, strict=True))
