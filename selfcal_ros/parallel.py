# SPDX-License-Identifier: Apache-2.0
"""One function over many items on all cores: a pool of processes, or dask.distributed.

Outcomes are yielded as they are ready. If a worker dies (out of memory, a signal), only its item
is lost. Every worker has one BLAS thread, and ends with the process that started it.
"""

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import forkserver, resource_tracker
from typing import cast

from threadpoolctl import threadpool_limits

from selfcal_ros.errors import InputError

AHEAD = 2
"""Items submitted per worker: enough that none waits for work."""
BLAS_THREADS = "OPENBLAS_NUM_THREADS"
"""Environment variable: threads started by OpenBLAS when loaded."""
FORKED = "selfcal_ros.forked"
LOCAL = "local"
"""Instead of a scheduler's address: a local dask cluster started for the run."""


Progress = Callable[[int, int], None]
"""Called with the number of items done, and the total."""


def silent(n_done: int, total: int) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Outcome[R]:
    """Outcome of an item: its index, and a value or an error."""

    index: int
    value: R | None = None
    error: BaseException | None = None


class WorkerDied(Exception):
    """Raised if the process of an item ended without an answer."""


def cores() -> int:
    """Return the number of cores available to this process."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else (os.cpu_count() or 1)
    )


def check_workers(number: int | None, option: str = "--workers") -> int:
    """Return the requested number of workers, all cores if None; InputError if invalid."""
    if number is None:
        return cores()
    if not 1 <= number <= 1024:
        raise InputError(
            option, f"{number} is not a number of workers", "give 1 to 1024"
        )
    return number


def begin(module: str, workers: int) -> None:
    """Begin importing the workers' modules, while this process imports its own.

    Parameters
    ----------
    module : str
        Full name of the module of the workers' function.
    workers : int
        With one worker, this process, there is nothing to begin.
    """
    if workers > 1 and _method() == "forkserver":
        _start_server(module)


def _start_server(module: str) -> None:
    """Start the process that forks workers, if necessary, with Ctrl-C blocked in it and in them.

    Ctrl-C reaches all processes of a terminal, also during imports; only the parent handles it.
    BLAS has one thread in all of them from the start: others would spin for 0.03 s in each
    library.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(
        [module, __name__, FORKED]
    )
    resource_tracker.ensure_running()  # which lets the signal through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    threads = os.environ.get(BLAS_THREADS)
    os.environ[BLAS_THREADS] = "1"
    try:
        forkserver.ensure_running()
    finally:
        if threads is None:
            del os.environ[BLAS_THREADS]
        else:
            os.environ[BLAS_THREADS] = threads
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def outcomes[T, R](
    function: Callable[[T], R],
    items: Sequence[T],
    *,
    workers: int = 1,
    dask: str = "",
) -> Iterator[Outcome[R]]:
    """Yield the outcome of `function` for each item, as it becomes ready.

    Parameters
    ----------
    function : callable
        Takes one item; from a module, so that workers can import it.
    items : sequence
        Its arguments.
    workers : int
        Processes; 1 = in this process, sequentially.
    dask : str
        Address of a dask scheduler, or `LOCAL`; empty = processes of the standard library.

    Raises
    ------
    InputError
        If dask is requested and not installed, or its scheduler does not answer.
    """
    if dask:
        yield from _with_dask(function, items, workers, dask)
    elif workers == 1 or len(items) < 2:
        yield from (_tried(function, items, index) for index in range(len(items)))
    else:
        yield from _with_processes(function, items, min(workers, len(items)))


def mapped[T, R](
    function: Callable[[T], R],
    items: Sequence[T],
    *,
    workers: int = 1,
    progress: Progress = silent,
) -> list[R]:
    """Return `function` of each item, in their order; the first error is raised.

    `progress` is called with the number of items done, and the total.
    """
    results: dict[int, R] = {}
    for n_done, outcome in enumerate(outcomes(function, items, workers=workers), 1):
        if outcome.error is not None:
            raise outcome.error
        results[outcome.index] = cast(R, outcome.value)
        progress(n_done, len(items))
    return [results[index] for index in range(len(items))]


def mapped_in_parts[T, R](
    function: Callable[[list[T]], list[R]],
    items: Sequence[T],
    *,
    workers: int = 1,
    size: int = 20,
    progress: Progress = silent,
) -> list[R]:
    """Return the results of `function` for lists of items, joined in their order.

    For items too small to be sent to a worker individually.
    """
    chunks = [list(items[start : start + size]) for start in range(0, len(items), size)]
    chunk_results = mapped(
        function,
        chunks,
        workers=workers,
        progress=lambda n_done, _: progress(min(n_done * size, len(items)), len(items)),
    )
    return [value for chunk in chunk_results for value in chunk]


def _tried[T, R](
    function: Callable[[T], R], items: Sequence[T], index: int
) -> Outcome[R]:
    try:
        return Outcome(index, function(items[index]))
    except Exception as error:
        return Outcome(index, error=error)


def _with_processes[T, R](
    function: Callable[[T], R], items: Sequence[T], workers: int
) -> Iterator[Outcome[R]]:
    """Yield outcomes of a pool; if it breaks, each of its items is retried separately."""
    waiting = list(reversed(range(len(items))))
    while waiting:
        suspects: list[int] = []
        with _pool(workers, function) as pool:
            running: dict[Future, int] = {}
            while waiting or running:
                while waiting and len(running) < AHEAD * workers and not suspects:
                    index = waiting.pop()
                    try:
                        running[pool.submit(function, items[index])] = index
                    except BrokenProcessPool:
                        suspects.append(index)
                ready, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in ready:
                    index = running.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        suspects.append(index)
                    else:
                        yield _outcome(index, future)
                if suspects and not running:
                    break
        for index in sorted(suspects):
            yield _in_own_process(function, items, index)


def _in_own_process[T, R](
    function: Callable[[T], R], items: Sequence[T], index: int
) -> Outcome[R]:
    """Return the outcome of an item in a separate process."""
    with _pool(1, function) as pool:
        future = pool.submit(function, items[index])
        wait([future])
        if isinstance(future.exception(), BrokenProcessPool):
            return Outcome(
                index,
                error=WorkerDied(
                    "the process that worked on it was killed (out of memory?)"
                ),
            )
        return _outcome(index, future)


def _outcome[R](index: int, future: Future[R]) -> Outcome[R]:
    error = future.exception()
    return (
        Outcome(index, error=error)
        if error is not None
        else Outcome(index, future.result())
    )


def _method() -> str:
    return (
        "forkserver"
        if "forkserver" in multiprocessing.get_all_start_methods()
        else "spawn"
    )


@contextlib.contextmanager
def _pool(workers: int, function: Callable) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool whose processes have ended when the block ends, however it ends.

    The modules of `function` are imported once, before the workers are forked.
    """
    context = multiprocessing.get_context(_method())
    if _method() == "forkserver":
        _start_server(
            getattr(getattr(function, "func", function), "__module__", None)
            or "builtins"
        )
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=begin_worker)
    try:
        yield pool
        pool.shutdown()
    except (KeyboardInterrupt, GeneratorExit):
        _end_server()
        raise
    finally:
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        pool.shutdown(cancel_futures=True)


def _end_server() -> None:
    """End the process that forks workers; the next pool starts another.

    It may still be importing: then it would fork the requested workers after this process has
    ended, and they would fail with a traceback. It has ended when this returns, and
    `multiprocessing` is left to detect this: a pool that assumed it alive would be refused.
    """
    pid = getattr(getattr(forkserver, "_forkserver", None), "_forkserver_pid", None)
    if pid is not None:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


def begin_worker() -> None:
    """Prepare a worker: one BLAS thread, Ctrl-C left to its parent, end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threadpool_limits(limits=1, user_api="blas")


def _end_with_parent() -> None:
    """End this process at once when its parent has ended, for any reason."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _with_dask[T, R](
    function: Callable[[T], R], items: Sequence[T], workers: int, address: str
) -> Iterator[Outcome[R]]:
    """Yield outcomes of a dask cluster."""
    try:
        from distributed import Client, LocalCluster, as_completed  # an extra, large
    except ImportError as error:
        raise InputError(
            "--dask",
            "there is no dask.distributed in this environment",
            "install it: pip install 'selfcal_ros[dask]'",
        ) from error
    with contextlib.ExitStack() as stack:
        try:
            if address == LOCAL:
                address = stack.enter_context(
                    LocalCluster(
                        n_workers=workers,
                        threads_per_worker=1,
                        dashboard_address=None,
                        silence_logs=logging.CRITICAL,
                    )
                )
            client = stack.enter_context(Client(address, set_as_default=False))
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                "--dask",
                f"no scheduler answers at {address} ({error})",
                f"start one, or write --dask {LOCAL}",
            ) from error
        futures = {
            client.submit(_in_dask, function, item, pure=False): index
            for index, item in enumerate(items)
        }
        for future in as_completed(futures, loop=client.loop):
            yield _outcome(futures[future], future)


def _in_dask[T, R](function: Callable[[T], R], item: T) -> R:
    with threadpool_limits(limits=1, user_api="blas"):
        return function(item)
