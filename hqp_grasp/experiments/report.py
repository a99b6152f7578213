"""Questions answered from results: what became of a study's trials, and of several side by side."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hqp_grasp.errors import InputError, ResultsError
from hqp_grasp.experiments.record import (
    CONVERGED_FORCE,
    CONVERGED_MOMENT,
    VERDICTS,
    floats,
    in_order,
    verdicts,
)

Z = 1.96  # standard deviations of a 95 % interval
SHOWN = 5  # trials named of each kind of failure
COLUMNS = (
    *("trial", "seed", "probe", "eps_f", "eps_m", "in_contact", "other_links"),
    *("limit_violation", "error", "adduction_deg", "outcome", "method"),
)


@dataclass(frozen=True)
class Outcome:
    """What became of one trial."""

    seed: int
    trial: int
    verdict: str  # one of VERDICTS
    balanced_at: int | None  # first probe from which force and moment stay balanced
    adduction: float  # [deg] at the last touch; NaN where there is none


def outcomes(folder: str | Path) -> list[Outcome]:
    """Every trial of a results folder, in order; raise ResultsError where there is none."""
    path = Path(folder) / "probes.parquet"
    try:
        have = pq.read_schema(path).names
        wanted = [name for name in (*COLUMNS, "eps_f_true", "eps_m_true") if name in have]
        table = pq.read_table(path, columns=wanted)
    except FileNotFoundError as error:
        raise ResultsError(f"{folder} has no probes.parquet: it is no results folder") from error
    except (pa.ArrowException, OSError) as error:
        raise ResultsError(f"{path} is broken ({error}); run its scenario again") from error
    table = in_order(table)
    verdict = verdicts(table)
    true = "_true" if "eps_f_true" in have else ""
    trial, seed = (table[name].to_numpy() for name in ("trial", "seed"))
    force, moment, adduction = (
        floats(table, name) for name in (f"eps_f{true}", f"eps_m{true}", "adduction_deg")
    )
    balanced = (force <= CONVERGED_FORCE) & (moment <= CONVERGED_MOMENT**2)  # NaN: not
    begin = np.flatnonzero(np.diff(trial, prepend=-1))
    end = np.append(begin[1:], len(trial))
    row = np.arange(len(trial))
    stays = (
        np.maximum.reduceat(np.where(balanced, -1, row), begin) + 1
    )  # the row from which it does
    stays = np.maximum(stays, begin)
    touch = np.maximum.reduceat(np.where(table["in_contact"].to_numpy(), row, -1), begin)
    return [
        Outcome(
            int(seed[first]),
            int(trial[first]),
            verdict[int(trial[first])],
            int(since - first) if since < after else None,
            float(adduction[last]) if last >= 0 else math.nan,
        )
        for first, after, since, last in zip(begin, end, stays, touch, strict=True)
    ]


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
    heads = ("good", *VERDICTS[1:], "probes to balance", "adduction at the end")
    rows = [f"{'':{width}}  {'trials':>6}  {'good [95 %]':>21}" + _cells(heads[1:])]
    for name, found in studies.items():
        count = Counter(outcome.verdict for outcome in found)
        low, high = interval(count["good"], len(found))
        good = f"{count['good']} [{low:.1%}, {high:.1%}]"
        at = [outcome.balanced_at for outcome in found if outcome.balanced_at is not None]
        angles = [o.adduction for o in found if o.verdict == "good" and math.isfinite(o.adduction)]
        probes = "–"
        if at:
            median, late = np.percentile(at, [50, 99])
            probes = f"{median:g} ({late:g}, {max(at)})"
        angle = f"{np.mean(angles):.1f} ± {np.std(angles):.1f}°" if angles else "–"
        cells = (*(str(count[kind]) for kind in VERDICTS[1:]), probes, angle)
        rows.append(f"{name:{width}}  {len(found):>6}  {good:>21}" + _cells(cells, heads[1:]))
    rows.append("probes to balance: median (99th percentile, worst)")
    for one, other in combinations(studies, 2):
        rows.append(_compared(one, other, studies[one], studies[other]))
    for name, found in studies.items():
        for kind in VERDICTS[1:]:
            failed = [o for o in found if o.verdict == kind]
            for outcome in failed[:SHOWN]:
                rows.append(
                    f"{kind}: trial {outcome.trial} of seed {outcome.seed}: "
                    f"python -m hqp_grasp view {name} --trial {outcome.trial}"
                )
            if len(failed) > SHOWN:
                rest = ", ".join(str(outcome.trial) for outcome in failed[SHOWN:])
                rows.append(f"{kind}: and trials {rest}")
    return "\n".join(rows)


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
