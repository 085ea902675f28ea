# SPDX-License-Identifier: Apache-2.0
"""The pool: outcomes in any order, errors, workers that die, one BLAS thread, no dask."""

import math
import operator
import os
import subprocess
import sys
from functools import partial
from multiprocessing import forkserver
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info

from selfcal_ros import parallel
from selfcal_ros.errors import InputError
from selfcal_ros.parallel import (
    WorkerDied,
    check_workers,
    cores,
    mapped,
    mapped_in_parts,
    outcomes,
)
from test.support.waiting import wait_until

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("workers", [1, 2])
def test_values_come_back_in_their_places(workers):
    numbers, seen = list(range(20)), []
    assert mapped(
        math.factorial, numbers, workers=workers, progress=lambda *at: seen.append(at)
    ) == [math.factorial(n) for n in numbers]
    assert seen == [(n, 20) for n in range(1, 21)]


@pytest.mark.parametrize("workers", [1, 2])
def test_parts_are_joined_in_their_order(workers):
    seen = []
    assert mapped_in_parts(
        sorted,
        [3, 1, 5, 4, 2],
        workers=workers,
        size=2,
        progress=lambda *at: seen.append(at),
    ) == [1, 3, 4, 5, 2]
    assert seen == [(2, 5), (4, 5), (5, 5)]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_the_outcome_of_its_item_alone(workers):
    found = {o.index: o for o in outcomes(math.sqrt, [4.0, -1.0, 9.0], workers=workers)}
    assert (found[0].value, found[2].value) == (2.0, 3.0)
    assert isinstance(found[1].error, ValueError) and found[1].value is None
    with pytest.raises(ValueError):
        mapped(math.sqrt, [4.0, -1.0], workers=workers)


class Asked(list):
    """Items that note which of them were asked for."""

    def __init__(self, items):
        super().__init__(items)
        self.order = []

    def __getitem__(self, index):
        self.order.append(index)
        return super().__getitem__(index)


def test_no_more_items_are_taken_than_workers_need_to_go_on():
    """Two for each: one that it works on, one that waits for it; the others are left alone."""
    items = Asked(range(12))
    for given, _ in enumerate(outcomes(math.factorial, items, workers=2)):
        assert len(items.order) <= given + 4
        assert given or len(items.order) == 4
    assert items.order == list(range(12))


def test_a_worker_that_dies_costs_its_own_item():
    jobs = [partial(int, n) for n in range(6)]
    jobs[2] = partial(os._exit, 9)
    found = {o.index: o for o in outcomes(operator.call, jobs, workers=2)}
    assert {i: o.value for i, o in found.items() if i != 2} == {
        0: 0,
        1: 1,
        3: 3,
        4: 4,
        5: 5,
    }
    assert isinstance(found[2].error, WorkerDied)
    assert (
        str(found[2].error)
        == "the process that worked on it was killed (out of memory?)"
    )


def test_a_worker_that_dies_early_leaves_all_other_items():
    """More items than are handed out at once wait when it dies."""
    jobs = [partial(os._exit, 9), *(partial(int, n) for n in range(1, 60))]
    found = {o.index: o for o in outcomes(operator.call, jobs, workers=2)}
    assert {i: o.value for i, o in found.items() if i} == {n: n for n in range(1, 60)}
    assert isinstance(found[0].error, WorkerDied)


def test_work_is_done_by_other_processes_with_one_blas_thread_each():
    jobs = [partial(__import__, "numpy"), os.getpid, os.getpid]
    pids = [o.value for o in outcomes(operator.call, jobs[1:], workers=2)]
    assert os.getpid() not in pids
    for info in mapped(operator.call, [threadpool_info] * 4, workers=2):
        assert all(
            pool["num_threads"] == 1 for pool in info if pool["user_api"] == "blas"
        )


def test_a_consumer_that_stops_takes_the_workers_along():
    import multiprocessing

    running = outcomes(operator.call, [os.getpid] * 40, workers=2)
    next(running)
    running.close()
    assert multiprocessing.active_children() == []


def is_alive(stat: Path) -> bool:
    """Tell if the process of /proc/PID/stat runs; it can end between opening and reading."""
    try:
        return ") Z" not in stat.read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_workers_end_with_a_process_that_is_killed():
    code = (
        "import operator, os, sys\nfrom selfcal_ros.parallel import outcomes\n"
        "found = outcomes(operator.call, [os.getpid] * 9, workers=2)\n"
        "print(next(found).value, flush=True)\nsys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as running:
        worker = Path("/proc", running.stdout.readline().strip(), "stat")
        assert is_alive(worker)
        running.kill()
    wait_until(lambda: not is_alive(worker), "the end of the worker")


@pytest.mark.parametrize(("workers", "known"), [(1, False), (2, True)])
def test_what_is_begun_is_imported_where_workers_are_forked(workers, known):
    code = (
        "from selfcal_ros.parallel import begin, mapped\n"
        f"begin('colorsys', {workers})\n"
        "print(mapped(eval, [\"'colorsys' in __import__('sys').modules\"] * 4, workers=2))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split("\n")[0] == str([known] * 4)


LOADED = """
import gc, os
from selfcal_ros.parallel import begin, mapped
os.environ.pop("OPENBLAS_NUM_THREADS", None)
if OTHERS:
    os.environ["OPENBLAS_NUM_THREADS"] = OTHERS
begin("numpy", 2)
assert os.environ.get("OPENBLAS_NUM_THREADS", "") == OTHERS
tasks = mapped(os.listdir, ["/proc/self/task"] * 4, workers=2)
print({len(found) for found in tasks})
print(set(mapped(os.getenv, ["OPENBLAS_NUM_THREADS"] * 4, workers=2)))
frozen = mapped(eval, ["__import__('gc').get_freeze_count()"] * 4, workers=2)
print(min(frozen) > 10_000 > gc.get_freeze_count())
"""


@pytest.mark.parametrize("others", ["", "2"])
def test_workers_start_without_threads_of_blas_and_leave_what_is_loaded_out_of_garbage(
    others,
):
    """One thread works, one waits for the end of the parent; the parent itself is as it was."""
    done = subprocess.run(
        [sys.executable, "-c", f"OTHERS = {others!r}" + LOADED],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stderr, done.stdout.splitlines()) == ("", ["{2}", "{'1'}", "True"])


def test_numbers_of_workers():
    assert check_workers(None) == cores() >= 1
    assert check_workers(3) == 3
    for number in (0, -1, 1025):
        with pytest.raises(InputError) as caught:
            check_workers(number)
        assert str(caught.value) == (
            f"--workers: {number} is not a number of workers; give 1 to 1024"
        )


def test_without_dask_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError) as caught:
        list(outcomes(math.sqrt, [1.0], dask="local"))
    assert str(caught.value) == (
        "--dask: there is no dask.distributed in this environment; install it: pip "
        "install 'selfcal_ros[dask]'"
    )


def test_dask_gives_the_same(monkeypatch):
    pytest.importorskip("distributed")
    found = {
        o.index: o
        for o in outcomes(math.sqrt, [4.0, -1.0, 9.0], workers=2, dask="local")
    }
    assert (found[0].value, found[2].value) == (2.0, 3.0)
    assert isinstance(found[1].error, ValueError)


INTERRUPTED = """
import signal
signal.raise_signal(signal.SIGINT)

def is_blocked(_):
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
"""
WITH_WORKERS = """
import signal
from selfcal_ros import parallel
parallel.begin("interrupted", 2)
signal.signal(signal.SIGINT, signal.SIG_IGN)  # this process imports it too
import interrupted
print(parallel.mapped(interrupted.is_blocked, [1, 2], workers=2))
"""


def test_an_interrupt_while_workers_import_is_left_to_their_parent(tmp_path):
    (tmp_path / "interrupted.py").write_text(INTERRUPTED)
    done = subprocess.run(
        [sys.executable, "-c", WITH_WORKERS],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "[True, True]\n", "")


def test_a_server_that_is_ended_has_ended_and_is_left_to_be_found_so():
    """The next pool asks whether it lives: one that is about to end would refuse the pool."""
    for _ in range(3):
        parallel._start_server("builtins")
        server = forkserver._forkserver._forkserver_pid
        parallel._end_server()
        assert (
            os.waitid(os.P_PID, server, os.WEXITED | os.WNOWAIT | os.WNOHANG)
            is not None
        )
    parallel._end_server()  # once more: there is none
    assert mapped(abs, [-1, -2], workers=2) == [1, 2]


SLOW = """
import os
from pathlib import Path
from test.support.waiting import wait_until
if os.getpid() != int(os.environ["MAIN"]):
    Path(__file__).with_name("begun").touch()
    wait_until(Path(__file__).with_name("go").exists, "the end of the import")

def twice(number):
    return 2 * number
"""
STOPPED = """
import os, signal, threading
from pathlib import Path
from test.support.waiting import wait_until
from selfcal_ros import parallel
os.environ["MAIN"] = str(os.getpid())
import slow

def interrupt():
    wait_until(Path(slow.__file__).with_name("begun").exists, "the import of the server")
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=interrupt).start()
try:
    parallel.mapped(slow.twice, [1, 2], workers=2)
except KeyboardInterrupt:
    print("stopped", flush=True)
Path(slow.__file__).with_name("go").touch()
"""


def test_workers_that_are_not_there_yet_do_not_come_after_an_interrupt(tmp_path):
    """They would find their queues gone, and say so in a traceback behind the prompt."""
    (tmp_path / "slow.py").write_text(SLOW)
    done = subprocess.run(
        [sys.executable, "-c", STOPPED],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "stopped\n", "")
