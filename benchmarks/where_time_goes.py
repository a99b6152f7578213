"""Where one HQP solve spends its time, on easy and hard three-level problems.

python benchmarks/where_time_goes.py --problems 300 --solver active-set
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import hqp_grasp as hg
from hqp_grasp.hierarchy import active_set, hqp

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from problems import three_level

PARTS = (
    (hqp, "stack"),
    (hqp, "active_rows"),
    (active_set, "search"),
    (hqp, "optimality"),
)


def main(problems: int = 300, seed: int = 0, solver: str = "proxqp") -> None:
    """Print medians in µs; what the parts do not cover is Python between them."""
    spent: defaultdict[str, list[float]] = defaultdict(list)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            begin = time.perf_counter()
            answer = function(*args, **options)
            spent[name].append(time.perf_counter() - begin)
            return answer

        return call

    for module, name in PARTS:
        setattr(module, name, timed(name, getattr(module, name)))
    solve = timed("whole solve", hg.HQP(solver).solve)
    build = timed("building the levels", lambda rows: [hg.Level(*r) for r in rows])
    for difficulty in ("easy", "hard"):
        rng = np.random.default_rng(seed)
        drawn = [three_level(rng, difficulty) for _ in range(problems)]
        hg.HQP(solver).solve(build(drawn[0]))
        spent.clear()
        for rows in drawn:
            solve(build(rows))
        print(f"\n{difficulty}, median µs")
        for name, times in spent.items():
            print(f"  {name:20} {1e6 * np.median(times):7.0f}")


if __name__ == "__main__":
    tyro.cli(main)
