"""Work is done wherever it is sent, again where a process dies, and never waited for in vain."""

import json
import pickle
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

import pytest
from deadly import Slow, Square, compiles, raises

from hqp_grasp.errors import InputError, MissingExtraError, WorkerError
from hqp_grasp.experiments import executor
from hqp_grasp.experiments.executor import address_of, run_all
from hqp_grasp.experiments.fingerprint import Fingerprint
from hqp_grasp.hierarchy import compiled

NO_DASK = "no distributed: pip install 'hqp_grasp[cluster]'"


@pytest.fixture
def silent():
    """A port that listens and never says a word, as its address."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


# ---------------------------------------------------------------- processes


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_number_is_done_once(jobs):
    assert sorted(run_all(Square(), range(9), jobs)) == [(i, i * i) for i in range(9)]


@pytest.fixture
def forked(monkeypatch):
    """Processes that are copies of one that has imported the package: each import takes a second.

    tests/experiments/test_study.py starts processes as users do.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload(["deadly", "hqp_grasp"])
    monkeypatch.setattr(executor, "get_context", lambda _: context)


@pytest.mark.usefixtures("forked")
def test_a_number_whose_process_dies_is_done_again(tmp_path):
    work = Square(deadly=(2,), times=2, marks=tmp_path)
    assert sorted(run_all(work, range(6), jobs=2)) == [(i, i * i) for i in range(6)]
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.usefixtures("forked")
def test_a_number_that_kills_every_process_is_given_up_and_costs_no_other():
    done = dict(run_all(Square(deadly=(2,)), range(6), jobs=2))
    assert done == {i: None if i == 2 else i * i for i in range(6)}


@pytest.mark.usefixtures("forked")
def test_where_no_process_does_anything_the_study_ends():
    with pytest.raises(WorkerError, match=r'every process died .* `if __name__ == "__main__":`'):
        list(run_all(Square(deadly=tuple(range(50))), range(50), jobs=2))


@pytest.mark.usefixtures("forked")
def test_processes_that_break_before_they_are_given_anything_are_started_again(monkeypatch):
    tries = []

    def in_pool(payload, waiting, jobs, suspects, turn):
        tries.append(list(waiting))
        while len(tries) > 1 and waiting:
            i = waiting.popleft()
            yield i, i

    monkeypatch.setattr(executor, "_in_pool", in_pool)
    assert list(run_all(Square(), range(3), jobs=2)) == [(0, 0), (1, 1), (2, 2)]
    assert tries == [[0, 1, 2], [0, 1, 2]]


def test_what_the_work_raises_is_raised():
    with pytest.raises(RuntimeError, match="not here"):
        list(run_all(raises, range(4), jobs=2))


def test_that_the_solver_is_compiled_is_said_once_and_only_then(monkeypatch, capsys):
    monkeypatch.setattr(compiled._NOTICE, "turn", threading.Semaphore(1))
    list(run_all(Square(), range(4)))
    assert capsys.readouterr().err == ""
    list(run_all(compiles, range(4)))
    assert capsys.readouterr().err.strip() == compiled.LINE


def test_that_the_solver_is_compiled_is_said_by_one_of_several_processes(capfd):
    list(run_all(compiles, range(4), jobs=2))
    assert capfd.readouterr().err.strip() == compiled.LINE


TYPED_IN = """
import hqp_grasp as hg
class MyTask(hg.ForceTask): pass
trial = hg.Trial(hg.Scene("bhand"), MyTask() >> hg.MomentTask(), probes=1)
try:
    hg.Study(trial, trials=2, jobs=2).run({out!r})
except hg.InputError as error:
    print(error)
"""


@pytest.mark.parametrize("way", ["-c", "stdin"])
def test_what_was_typed_in_is_refused_before_any_process_or_folder(way, tmp_path):
    script = TYPED_IN.format(out=str(tmp_path / "out"))
    command = [sys.executable, *(("-c", script) if way == "-c" else ("-",))]
    done = subprocess.run(command, input=script, capture_output=True, text=True, check=True)
    assert "cannot read MyTask, which was typed in (python -c, standard input, a n" in done.stdout
    assert "a .py file, and import it from there, or take jobs=1" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_pickled_is_refused_with_the_way_out():
    with pytest.raises(InputError, match=r"(?s)jobs above 1 .*<lambda>.*or take jobs=1"):
        run_all(lambda i: i, range(4), jobs=2)


def test_what_another_process_does_not_find_is_said():
    payload = pickle.dumps(Square()).replace(b"Square", b"Cubics")
    with pytest.raises(WorkerError, match=r"does not find .*Cubics.* at the top of a module"):
        executor._unpickled(payload)


def test_a_process_reads_its_work_once():
    payload = pickle.dumps(Square())
    assert executor._unpickled(payload) is executor._unpickled(pickle.dumps(Square()))


@pytest.mark.usefixtures("forked")
def test_few_numbers_are_under_way_at_a_time(monkeypatch):
    submitted, submit = [], executor.ProcessPoolExecutor.submit

    def counted(pool, do, payload, i):
        submitted.append(i)
        return submit(pool, do, payload, i)

    monkeypatch.setattr(executor.ProcessPoolExecutor, "submit", counted)
    for done, _ in enumerate(run_all(Square(), range(40), jobs=2)):
        assert len(submitted) - done <= 2 * executor.IN_FLIGHT
    assert sorted(submitted) == list(range(40))


# ---------------------------------------------------------------- addresses


def test_an_address_stands_as_it_is_or_in_the_schedulers_file(tmp_path):
    assert address_of("tcp://node7:8786") == "tcp://node7:8786"
    assert address_of("node7:8786") == "node7:8786"
    (tmp_path / "scheduler.json").write_text(json.dumps({"address": "tcp://10.0.0.1:40001"}))
    assert address_of(tmp_path / "scheduler.json") == "tcp://10.0.0.1:40001"


@pytest.mark.parametrize("cluster", ["scheduler.json", "tcp://node7", "node7:", ""])
def test_what_is_neither_address_nor_file_is_said(cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="the address of a Dask scheduler, tcp://host:8786, or"):
        address_of(cluster)


def test_a_cluster_object_is_told_to_give_its_address():
    class LocalCluster:
        scheduler_address = "tcp://127.0.0.1:8786"

    with pytest.raises(InputError, match=r"cluster\.scheduler_address .* got a LocalCluster"):
        address_of(LocalCluster())


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_a_file_that_no_scheduler_wrote_is_said(text, tmp_path):
    (tmp_path / "s.json").write_text(text)
    with pytest.raises(InputError, match=r"s\.json is no scheduler file, as `dask scheduler"):
        address_of(tmp_path / "s.json")


# ---------------------------------------------------------------- no cluster


def test_without_dask_the_line_that_installs_it_is_given(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask", None)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'distributed>=2025.1'$"):
        list(run_all(Square(), range(3), cluster="tcp://127.0.0.1:8786"))


def took(address, monkeypatch):
    """How long it took to say so [s], had it waited as long as it does."""
    pytest.importorskip("distributed", reason=NO_DASK)
    patience = executor.ANSWER
    monkeypatch.setattr(executor, "ANSWER", 1.0)
    begin = time.monotonic()
    with pytest.raises(WorkerError, match=f"no Dask scheduler answers at {address} within 1 s"):
        list(run_all(Square(), range(3), cluster=address))
    return patience + time.monotonic() - begin - 1.0


def test_an_address_where_nobody_listens_is_an_error_within_ten_seconds(silent, monkeypatch):
    host, port = silent.rsplit(":", 1)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    assert took(f"{host}:{port}", monkeypatch) < 10.0


def test_an_address_that_never_speaks_is_an_error_within_ten_seconds(silent, monkeypatch):
    assert took(silent, monkeypatch) < 10.0


# ---------------------------------------------------------------- the same software


@pytest.fixture
def sent():
    """What a worker gets, the expectations as a dictionary to be changed."""
    cloudpickle = pytest.importorskip("cloudpickle", reason=NO_DASK)
    executor._load.cache_clear()
    work = Square(deadly=(7,))
    return cloudpickle.dumps(work), Fingerprint(work).parts


def test_a_worker_with_the_same_software_does_the_work(sent):
    payload, expected = sent
    assert executor._do(payload, json.dumps(expected), 3) == 9


def test_a_worker_of_several_threads_does_one_thing_at_a_time():
    cloudpickle = pytest.importorskip("cloudpickle", reason=NO_DASK)
    payload = cloudpickle.dumps(Slow())
    expected = json.dumps(Fingerprint(Slow()).parts)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda i: executor._do(payload, expected, i), range(8)))
    assert Slow.most == 1


@pytest.mark.parametrize(
    ("part", "value", "told"),
    [
        ("hqp_grasp", "sha256:other", "hqp_grasp differs"),
        ("versions", {"mujoco": "1.0"}, r"versions\.mujoco is '1\.0' there"),
        ("trial", {"deadly": [8]}, r"trial\.deadly\[0\] is 8 there, 7 here"),
        ("source", {"deadly": "sha256:other"}, r"source\.deadly differs"),
    ],
)
def test_a_worker_with_other_software_refuses_and_names_it(sent, part, value, told):
    payload, expected = sent
    spoilt = {**expected[part], **value} if isinstance(value, dict) else value
    with pytest.raises(WorkerError, match=rf"worker .* differs from the client: .*{told}"):
        executor._do(payload, json.dumps(expected | {part: spoilt}), 3)


def test_software_is_compared_before_the_work_is_unpacked(sent):
    _, expected = sent
    other = expected | {"hqp_grasp": "sha256:other"}
    with pytest.raises(WorkerError, match="hqp_grasp differs"):
        executor._do(b"of another version", json.dumps(other), 3)


def test_what_was_made_in_a_script_travels_with_the_work(sent):
    payload, expected = sent
    there = expected | {"source": expected["source"] | {"__main__": "sha256:mine"}}
    assert executor._do(payload, json.dumps(there), 3) == 9


# ---------------------------------------------------------------- a scheduler worked out by hand


class Killed(Exception):  # noqa: N818 - as Dask names it
    """What a scheduler says of a task that cost several workers."""


class Future:
    """A task that ends at once: with a result, an error, or lost so many times before."""

    def __init__(self, key, ends, lost=0):
        self.key, self.ends, self.lost = key, ends, lost
        self.status = "error" if isinstance(ends, Exception) else "finished"

    def add_done_callback(self, call):
        call(self)

    def exception(self, timeout):
        if self.lost:
            self.lost -= 1
            raise OSError("the worker is gone")
        return self.ends if self.status == "error" else None

    def result(self, timeout):
        return self.ends


class Client:
    """A scheduler whose workers have so many threads; `ends` says how a number ends."""

    status = "running"
    scheduler = type("Scheduler", (), {"ncores": "ncores"})

    def __init__(self, threads, ends):
        self.threads, self.ends = threads, ends
        self.submitted, self.asked = [], 0

    def sync(self, call, callback_timeout):
        assert (call, callback_timeout) == ("ncores", 10.0)
        self.asked += 1
        return {f"worker {i}": count for i, count in enumerate(self.threads)}

    def submit(self, do, payload, expected, i, key):
        assert (do, payload, expected) == (executor._do, b"work", "{}")
        self.submitted.append(i)
        future = self.ends(i)
        future.key = key
        return future


@pytest.fixture
def connected(monkeypatch):
    """Returns a connection to such a scheduler, and what it said."""
    said = []
    monkeypatch.setattr(executor, "tell", said.append)

    def connect(ends, threads=(1, 1)):
        cluster = object.__new__(executor._Cluster)
        cluster._client = Client(threads, ends)
        cluster._distributed = type("Distributed", (), {"KilledWorker": Killed})
        cluster._payload, cluster._expected, cluster._address = b"work", "{}", "tcp://there:1"
        cluster._told, cluster._workers_seen = set(), time.monotonic()
        return cluster, said

    return connect


def results(run):
    """What a generator yields, and what it returns."""
    found = []
    while True:
        try:
            found.append(next(run))
        except StopIteration as end:
            return found, end.value


def test_a_cluster_does_every_number_and_asks_now_and_then_who_is_there(connected):
    cluster, said = connected(lambda i: Future("", i * i))
    run = cluster.run(range(9))
    assert next(run) == (0, 0)
    assert cluster._client.submitted == [0, 1, 2, 3]  # two for each of two threads
    found, lost = results(run)
    assert [(0, 0), *found] == [(i, i * i) for i in range(9)] and lost == []
    assert cluster._client.asked == 1 and said == []


def test_a_result_that_its_worker_took_along_is_asked_for_again(connected):
    cluster, _ = connected(lambda i: Future("", i, lost=2 * (i == 1)))
    found, lost = results(cluster.run(range(3)))
    assert sorted(found) == [(0, 0), (1, 1), (2, 2)] and lost == []
    assert cluster._client.asked == 3  # who is there is asked at once, each time


def test_a_number_that_costs_worker_after_worker_is_tried_alone_and_given_up(
    connected, monkeypatch
):
    tries = []

    def ends(i):
        tries.append(i)
        deadly = i == 2 or (i == 3 and tries.count(3) == 1)  # one was next to it
        return Future("", Killed(i) if deadly else i)

    cluster, _ = connected(ends)
    found, lost = results(cluster.run(range(5)))
    assert sorted(found) == [(0, 0), (1, 1), (4, 4)] and lost == [2, 3]
    tries.clear()

    class There:
        def __enter__(self):
            return cluster

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(executor, "_Cluster", lambda work, address: There())
    found = list(executor._on_cluster(None, range(5), "tcp://there:1"))
    assert sorted(found[:3]) == [(0, 0), (1, 1), (4, 4)] and sorted(found[3:]) == [
        (2, None),
        (3, 3),
    ]


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ZeroDivisionError("of mine"), "cannot do the work: ZeroDivisionError: of mine"),
        (WorkerError("not the same software"), "cannot do the work: not the same software"),
    ],
)
def test_what_the_work_raises_on_a_cluster_is_told_with_its_name(connected, error, told):
    cluster, _ = connected(lambda i: Future("", error if i == 1 else i))
    with pytest.raises(WorkerError, match=f"the cluster at tcp://there:1 {told}"):
        list(cluster.run(range(3)))


def test_a_scheduler_that_goes_is_an_error_that_says_so(connected):
    cluster, _ = connected(lambda i: Future("", i))
    cancelled = Future("", 0)
    cancelled.status = "cancelled"
    for lost in (lambda: cluster._outcome(cancelled), cluster._threads):
        cluster._client.status = "closed"
        with pytest.raises(WorkerError, match=r"tcp://there:1 is gone \(the connection is lost\)"):
            lost()
    cluster._client.status = "running"
    waiting = Future("", 0)
    waiting.status = "pending"
    with pytest.raises(TimeoutError):
        cluster._outcome(waiting)

    def refuses(*_, **__):
        raise OSError("no route")

    cluster._client.sync = refuses
    with pytest.raises(WorkerError, match=r"is gone \(OSError: no route\)"):
        cluster._threads()


def test_workers_are_waited_for_and_threads_that_do_nothing_are_told_once(connected):
    cluster, said = connected(None, threads=())
    assert cluster._threads() == cluster._threads() == 0
    (waits,) = said
    assert "has no worker: waiting up to 300 s; `dask worker tcp://there:1 --nw" in waits
    cluster._workers_seen -= 299.0
    assert cluster._threads() == 0
    cluster._workers_seen -= 2.0
    with pytest.raises(WorkerError, match="has had no worker for 300 s"):
        cluster._threads()
    cluster._client.threads = (1, 1, 1)
    assert cluster._threads() == 3 and len(said) == 1
    cluster._client.threads = ()
    assert cluster._threads() == 0  # it has seen some since
    cluster._client.threads = (1, 4)
    assert cluster._threads() == cluster._threads() == 5
    assert len(said) == 2 and "one trial at a time, however many threads it has" in said[1]
