"""Studies on a Dask cluster: the same bits whatever is killed, how much faster, how large.

python benchmarks/cluster.py --kills 10 --rounds 3 --large 10000
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import tyro

import hqp_grasp as hg
from hqp_grasp.experiments import study as study_module
from hqp_grasp.experiments.executor import need

POLL = 0.2  # [s] between looks at a process's memory


def main(
    kills: int = 10, rounds: int = 3, trials: int = 400, probes: int = 40, large: int = 0
) -> None:
    """Print what came of it.

    Args:
        kills: Runs in which one of two workers is killed at a random moment.
        rounds: Interleaved runs of one worker, two workers and the local pool; 0: none.
        trials: Trials in each of these runs.
        probes: Probes in each trial.
        large: Trials of one large study in the local pool; 0: none.
    """
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        if kills:
            killed(Path(folder), kills)
        if rounds:
            faster(Path(folder), rounds, trials, probes)
        if large:
            largest(Path(folder), large, probes)


def study_of(trials: int, probes: int, **settings: Any) -> hg.Study:
    scene = hg.Scene(object=hg.Cylinder(0.05))
    stack = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()
    return hg.Study(hg.Trial(scene, stack, probes=probes), trials, **settings)


@contextmanager
def cluster_of(workers: int) -> Iterator[Any]:
    """A cluster of worker processes, each of which has run a trial."""
    with need("distributed").LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address=":0",
        silence_logs=50,  # that a worker died is what we want to see survived
    ) as cluster:
        with tempfile.TemporaryDirectory() as out:
            study_of(4 * workers, 1, cluster=cluster.scheduler_address).run(out)
        yield cluster


# ---------------------------------------------------------------- kills


def killed(folder: Path, runs: int) -> None:
    """Kill one of two workers in each run, at a moment drawn anew; compare with no kill at all."""
    trials, probes = 60, 10
    expected = study_of(trials, probes).run(folder / "whole")
    moments, equal = [], 0
    for run in range(runs):
        rng = random.Random(run)
        with cluster_of(2) as cluster, ThreadPoolExecutor(1) as aside:
            out = folder / f"killed_{run}"
            victim = rng.choice([worker.process.pid for worker in cluster.workers.values()])
            at, pause = rng.randrange(1, trials - 4), rng.uniform(0.0, 0.1)
            moment = aside.submit(kill_once, out, at, pause, victim)
            table = study_of(trials, probes, cluster=cluster.scheduler_address).run(out)
            moments.append(moment.result())
        equal += same(table, expected)
    print(f"\n{runs} runs of {trials} trials on two workers, one killed in each")
    print(f"  killed after … trials   {', '.join(map(str, moments))}")
    print(f"  before the end          {sum(moment < trials for moment in moments)} of {runs}")
    print(f"  equal bit for bit       {equal} of {runs}, solve_us aside")


def kill_once(out: Path, trials: int, pause: float, victim: int) -> int:
    """Kill a process `pause` seconds after so many trials; return how many there were by then."""
    parts = out / "parts"
    while len(list(parts.glob("trial_*.parquet"))) < trials:
        time.sleep(0.002)
    time.sleep(pause)
    finished = len(list(parts.glob("trial_*.parquet")))
    os.kill(victim, signal.SIGKILL)
    return finished


def same(one: pa.Table, other: pa.Table) -> bool:
    timings = ["solve_us"]
    return bool(one.drop_columns(timings).equals(other.drop_columns(timings), check_metadata=True))


# ---------------------------------------------------------------- speed


def faster(folder: Path, rounds: int, trials: int, probes: int) -> None:
    """Trials a second, from the first trial finished to the last."""
    rates: dict[str, list[float]] = {}
    with ExitStack() as stack:
        one = stack.enter_context(cluster_of(1)).scheduler_address
        two = stack.enter_context(cluster_of(2)).scheduler_address
        kinds: dict[str, dict[str, Any]] = {
            "one worker": {"cluster": one},
            "two workers": {"cluster": two},
            "local, one process": {"jobs": 1},
            "local pool of two": {"jobs": 2},
        }
        for run in range(rounds):
            for kind, settings in kinds.items():
                out = folder / f"speed_{run}"
                with finishing() as times:
                    study_of(trials, probes, **settings).run(out)
                shutil.rmtree(out)
                rate = (len(times) - 1) / (times[-1] - times[0])
                rates.setdefault(kind, []).append(rate)
                print(f"{kind}: {rate:.2f} trials/s", file=sys.stderr)
    print(f"\n{trials} trials of {probes} probes, median of {rounds} interleaved runs")
    slowest = np.median(rates["one worker"])
    for kind, found in rates.items():
        each = ", ".join(f"{rate:.2f}" for rate in found)
        print(f"  {kind:20} {np.median(found):6.2f} trials/s ({each})")
    print(f"  two workers against one      {np.median(rates['two workers']) / slowest:.2f} ×")
    alone = np.median(rates["local, one process"])
    print(f"  local pool against one       {np.median(rates['local pool of two']) / alone:.2f} ×")


@contextmanager
def finishing() -> Iterator[list[float]]:
    """The moments at which trials are written."""
    times: list[float] = []
    add = study_module.Parts.add

    def noted(parts: Any, trial: int, table: pa.Table) -> None:
        add(parts, trial, table)
        times.append(time.perf_counter())

    study_module.Parts.add = noted  # type: ignore[method-assign]
    try:
        yield times
    finally:
        study_module.Parts.add = add  # type: ignore[method-assign]


# ---------------------------------------------------------------- size


def largest(folder: Path, trials: int, probes: int) -> None:
    """One study by the command line: time, memory of the client, disk, and its report."""
    out = folder / "large"
    size = ("--trials", str(trials), "--probes", str(probes))
    print(f"\n{trials} trials of {probes} probes, local pool of two")
    wall, peak = watched("run", "cylinder", *size, "--jobs", "2", "--out", str(out))
    print(f"  wall time               {wall:.0f} s")
    print(f"  client's peak memory    {peak / 1e6:.0f} MB")
    parts = list((out / "parts").iterdir())
    whole = (out / "probes.parquet").stat().st_size
    print(f"  probes.parquet          {whole / 1e6:.0f} MB")
    print(f"  parts                   {sum(p.stat().st_size for p in parts) / 1e6:.0f} MB in")
    print(f"                          {len(parts)} files")
    wall, peak = watched("report", str(out))
    print(f"  report                  {wall:.1f} s, {peak / 1e6:.0f} MB")
    wall, peak = watched("run", "cylinder", *size, "--jobs", "2", "--out", str(out))
    print(f"  the same command again  {wall:.0f} s, {peak / 1e6:.0f} MB: nothing is run")


def watched(*arguments: str) -> tuple[float, int]:
    """Run a command of hqp_grasp; its wall time [s], and the peak of its own memory [B]."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "hqp_grasp", *arguments]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        peak = 0
        status = Path(f"/proc/{process.pid}/status")
        while process.poll() is None:
            for line in status.read_text().splitlines():
                if line.startswith("VmHWM:"):
                    peak = 1024 * int(line.split()[1])
            time.sleep(POLL)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    return time.perf_counter() - begin, peak


if __name__ == "__main__":
    tyro.cli(main)
