"""Where work is done: in this process, in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import asyncio
import importlib
import io
import json
import logging
import os
import pickle
import re
import sys
import threading
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from types import FunctionType
from typing import Any, TypeVar

from tqdm import tqdm

from hqp_grasp.errors import InputError, WorkerError, missing
from hqp_grasp.experiments.fingerprint import Fingerprint, differences
from hqp_grasp.hierarchy.compiled import Turn, take_turns

T = TypeVar("T")
Done = Generator[tuple[int, T | None], None, None]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
IN_FLIGHT = 2  # numbers given to each worker at a time: the next one waits where it will run
DEATHS = 3  # times that a number alone may cost its process before it is given up
ANSWER = 6.0  # [s] within which a scheduler must answer at first
ASK = 4.0  # [s] between questions to the scheduler, whether it is still there
ALIVE = 10.0  # [s] within which it must answer them
SILENT = 20.0  # [s] after which a connection without an answer counts as broken
WORKERS = 300.0  # [s] to wait for a worker: a queue may have to start one


def run_all(
    work: Callable[[int], T],
    numbers: Sequence[int],
    jobs: int = 1,
    cluster: str | Path | None = None,
) -> Done[T]:
    """Yield each number with work(number) as it is done; None where it costs every process.

    In `jobs` processes of this machine, or on the Dask cluster whose scheduler has the address, or
    wrote the file, `cluster`. A few numbers a worker are under way at any time. One whose process
    dies is done again; one that brings down every process is given up. Raises WorkerError where
    there is nobody to do the work, or not the same software.
    """
    if cluster is not None:
        return _on_cluster(work, numbers, address_of(cluster))
    if jobs == 1 or len(numbers) < 2:
        return ((i, work(i)) for i in numbers)
    return _in_processes(pickled(work), numbers, jobs)


# ---------------------------------------------------------------- processes of this machine


class _Pickler(pickle.Pickler):
    """Takes down which classes and functions are those of the script that runs."""

    def __init__(self, stream: io.BytesIO) -> None:
        super().__init__(stream)
        self.own: list[str] = []

    def reducer_override(self, thing: Any) -> Any:
        if isinstance(thing, type | FunctionType) and thing.__module__ == "__main__":
            self.own.append(thing.__qualname__)
        return NotImplemented


def pickled(work: object) -> bytes:
    """What goes to other processes; InputError for what they could not read."""
    way_out = "put it into a module, a .py file, and import it from there, or take jobs=1"
    stream = io.BytesIO()
    pickler = _Pickler(stream)
    try:
        pickler.dump(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(f"jobs above 1 run in other processes, and {error}: {way_out}") from error
    script = sys.modules["__main__"]
    if script.__spec__ is None and not Path(vars(script).get("__file__", "")).is_file():
        for name in pickler.own:
            raise InputError(
                f"jobs above 1 run in other processes, and these cannot read {name}, which was "
                f"typed in (python -c, standard input, a notebook): {way_out}"
            )
    return stream.getvalue()


def _in_processes(payload: bytes, numbers: Sequence[int], jobs: int) -> Done[Any]:
    waiting = deque(numbers)
    worked = False
    turn = get_context("spawn").Semaphore(1)
    with _one_blas_thread():
        while waiting:
            suspects: list[int] = []  # under way when a process died
            for i, result in _in_pool(payload, waiting, jobs, suspects, turn):
                worked = True
                yield i, result
            given_up = []
            for i in suspects:
                for _ in range(DEATHS):
                    died: list[int] = []
                    for _, result in _in_pool(payload, deque([i]), 1, died, turn):
                        worked = True
                        yield i, result
                    if not died:
                        break
                else:
                    given_up.append(i)
            if given_up and not worked:
                raise WorkerError(
                    "every process died before it had done anything: out of memory? A script that "
                    'runs a study in several processes needs `if __name__ == "__main__":`'
                )
            yield from ((i, None) for i in given_up)


def _in_pool(
    payload: bytes, waiting: deque[int], jobs: int, suspects: list[int], turn: Turn
) -> Generator[tuple[int, Any], None, None]:
    """Work until nothing is waiting, or a process dies: `suspects` are then those under way.

    `turn` is taken by the process that says that it compiles the solver.
    """
    with ProcessPoolExecutor(jobs, get_context("spawn"), take_turns, (turn,)) as pool:
        under_way: dict[Any, int] = {}
        try:
            while under_way or (waiting and not suspects):
                while waiting and not suspects and len(under_way) < IN_FLIGHT * jobs:
                    try:
                        under_way[pool.submit(_do_pickled, payload, waiting[0])] = waiting[0]
                    except BrokenProcessPool:
                        break
                    waiting.popleft()
                if not under_way:
                    return
                for future in wait(under_way, return_when="FIRST_COMPLETED").done:
                    i = under_way.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        suspects.append(i)
                    else:
                        yield i, future.result()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _do_pickled(payload: bytes, i: int) -> Any:
    """One task, in a process."""
    return _unpickled(payload)(i)


@lru_cache(maxsize=1)
def _unpickled(payload: bytes) -> Callable[[int], Any]:
    """The work; what it was made of may not be there, as what a script defines where it starts."""
    try:
        return pickle.loads(payload)
    except (AttributeError, ImportError) as error:
        raise WorkerError(
            f"another process does not find what this one has ({error}): define it at the top of "
            'a module, above any `if __name__ == "__main__":`'
        ) from error


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Workers inherit the environment: one thread each, so that they do not crowd the cores."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# ---------------------------------------------------------------- a Dask cluster


def address_of(cluster: str | Path) -> str:
    """The scheduler's address: as it stands, or as the scheduler wrote it into a file."""
    if not isinstance(cluster, str | Path):
        raise InputError(
            f"a cluster is told by its scheduler's address, such as cluster.scheduler_address of a "
            f"LocalCluster; got a {type(cluster).__name__}"
        )
    text, path = str(cluster), Path(cluster)
    if path.is_file():
        try:
            return str(json.loads(path.read_text())["address"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} is no scheduler file, as `dask scheduler --scheduler-file {path}` writes "
                f"it: {type(error).__name__}: {error}"
            ) from error
    if not re.fullmatch(r"(\w+://)?[^\s/]+:\d+", text):
        raise InputError(
            "a cluster is the address of a Dask scheduler, tcp://host:8786, or the file which "
            f"`dask scheduler --scheduler-file FILE` writes; there is no file {text!r}"
        )
    return text


def _on_cluster(work: Callable[[int], T], numbers: Sequence[int], address: str) -> Done[T]:
    with _Cluster(work, address) as cluster:
        suspects = yield from cluster.run(numbers)
        for i in suspects:  # others may have been to blame
            for number in (yield from cluster.run([i])):
                yield number, None


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Without the log of what is going to be raised anyway."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


class _Cluster:
    """A connection to a scheduler, over which one kind of work is done."""

    def __init__(self, work: Callable[[int], Any], address: str) -> None:
        self._dask = need("dask")
        self._distributed = need("distributed")
        self._address = address
        self._expected = json.dumps(Fingerprint(work).parts)
        self._payload = importlib.import_module("cloudpickle").dumps(work)

    def __enter__(self) -> _Cluster:
        with ExitStack() as stack:
            # Dask's own are 30 s each.
            patience = {"connect": f"{ANSWER}s", "tcp": f"{SILENT}s"}
            stack.enter_context(self._dask.config.set({"distributed.comm.timeouts": patience}))
            stack.enter_context(_quiet("distributed.client"))
            self._knock()
            self._client = self._distributed.Client(
                self._address, timeout=ANSWER, set_as_default=False, name="hqp_grasp"
            )
            stack.callback(self._client.close, timeout=2.0)
            self._open = stack.pop_all()
        self._workers_seen = monotonic()
        self._told: set[str] = set()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _knock(self) -> None:
        """Raise WorkerError unless a scheduler answers: a Client would wait for ever."""

        async def knock() -> Any:
            keys = self._distributed.Security().get_connection_args("client")
            async with self._distributed.rpc(self._address, connection_args=keys) as there:
                return await there.identity()

        try:
            with ThreadPoolExecutor(1) as aside:  # this thread may have a loop of its own
                found = aside.submit(asyncio.run, asyncio.wait_for(knock(), ANSWER)).result()
            if found["type"] != "Scheduler":
                raise WorkerError(f"it is a {found['type'].lower()}")
        except Exception as error:  # what answers may be anything, and so may what comes of it
            raise WorkerError(
                f"no Dask scheduler answers at {self._address} within {ANSWER:g} s "
                f"({str(error) or type(error).__name__}); start one with `dask scheduler`, and "
                "workers with `dask worker`"
            ) from error

    def run(self, numbers: Sequence[int]) -> Generator[tuple[int, Any], None, list[int]]:
        """Yield each number with its result; return those whose workers died, again and again."""
        waiting, suspects = deque(numbers), []
        under_way: dict[str, tuple[int, Any]] = {}
        done: SimpleQueue[Any] = SimpleQueue()
        token, asked, width = uuid.uuid4().hex, -ASK, 0
        while waiting or under_way:
            if monotonic() - asked >= ASK:
                width, asked = max(1, IN_FLIGHT * self._threads()), monotonic()
            while waiting and len(under_way) < width:
                i = waiting.popleft()
                future = self._client.submit(
                    _do, self._payload, self._expected, i, key=f"hqp_grasp-{token}-{i}"
                )
                under_way[future.key] = (i, future)
                future.add_done_callback(done.put)
            try:
                future = done.get(timeout=ASK)
            except Empty:
                continue
            try:
                error, result = self._outcome(future)
            except (CancelledError, OSError, self._distributed.KilledWorker):
                # The worker died before it handed over the result: done again. Or the scheduler.
                future.add_done_callback(done.put)
                asked = -ASK
                continue
            i, _ = under_way.pop(future.key)
            if error is None:
                yield i, result
            elif isinstance(error, self._distributed.KilledWorker):
                suspects.append(i)
            else:
                name = "" if isinstance(error, WorkerError) else f"{type(error).__name__}: "
                raise WorkerError(
                    f"the cluster at {self._address} cannot do the work: {name}{error}"
                ) from error
        return suspects

    def _outcome(self, future: Any) -> tuple[Exception | None, Any]:
        """What ended a task, and its result; OSError where both are lost."""
        if future.status == "cancelled":
            raise self._gone("the connection is lost")
        if future.status not in ("finished", "error"):
            raise TimeoutError
        error = future.exception(timeout=ALIVE)
        return error, None if error is not None else future.result(timeout=ALIVE)

    def _threads(self) -> int:
        """How many tasks the workers take at a time; WorkerError where the scheduler is gone."""
        if self._client.status != "running":
            raise self._gone("the connection is lost")
        try:
            there = self._client.sync(self._client.scheduler.ncores, callback_timeout=ALIVE)
        except (OSError, RuntimeError) as error:
            raise self._gone(f"{type(error).__name__}: {error}") from error
        now = monotonic()
        if there:
            self._workers_seen = now
        elif now - self._workers_seen > WORKERS:
            raise WorkerError(
                f"the scheduler at {self._address} has had no worker for {WORKERS:g} s"
            )
        start = f"`dask worker {self._address} --nworkers auto --nthreads 1`"
        if not there:
            self._tell(f"the scheduler has no worker: waiting up to {WORKERS:g} s; {start}")
        if max(there.values(), default=1) > 1:
            self._tell(f"a worker runs one trial at a time, however many threads it has; {start}")
        return sum(there.values())

    def _tell(self, message: str) -> None:
        """Say it once."""
        if message not in self._told:
            self._told.add(message)
            tell(message)

    def _gone(self, why: str) -> WorkerError:
        return WorkerError(f"the scheduler at {self._address} is gone ({why})")


_ALONE = threading.Lock()  # a worker of several threads still does one thing at a time


def _do(payload: bytes, expected: str, i: int) -> Any:
    """One task, on a worker."""
    with _ALONE:
        return _load(payload, expected)(i)


@lru_cache(maxsize=1)
def _load(payload: bytes, expected: str) -> Callable[[int], Any]:
    """The work, once it is sure that it is the same here as where it was sent from."""
    there = json.loads(expected)
    here = Fingerprint(None).parts
    _require_same(there, here, ("hqp_grasp", "versions"))
    work = importlib.import_module("cloudpickle").loads(payload)
    here = json.loads(json.dumps(Fingerprint(work).parts))
    # What was made in a script travels with the work, and has no file here.
    files = there["source"].keys() & here["source"].keys()
    for parts in (there, here):
        parts["source"] = {name: parts["source"][name] for name in files}
    _require_same(there, here, tuple(there))
    return work


def _require_same(there: dict[str, Any], here: dict[str, Any], names: Sequence[str]) -> None:
    found = list(differences({n: there[n] for n in names}, {n: here[n] for n in names}))
    if found:
        more = f", and {len(found) - 3} more" if len(found) > 3 else ""
        raise WorkerError(
            f"worker {os.uname().nodename}:{os.getpid()} differs from the client: "
            f"{'; '.join(found[:3])}{more} (there: the client, here: the worker); "
            "give both the same hqp_grasp, Python and libraries"
        )


def need(package: str) -> Any:
    """A package of the extra `cluster`, or MissingExtraError with the line that installs it."""
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise missing("cluster", package, "a cluster") from error


def tell(message: str) -> None:
    """Say something beside the progress bar."""
    tqdm.write(message, file=sys.stderr)
