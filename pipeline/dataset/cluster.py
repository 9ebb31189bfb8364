"""Make the epochs of a set on Dask's distributed: on local processes, or on a scheduler at an address.

Dask provides the queue and the retries. Local processes use TLS with keys that exist in memory for one job only, so that no other
user of the machine can give them work; there is no dashboard. The user's own scheduler is as open as the user set it up.
"""

from __future__ import annotations

import logging
import multiprocessing.resource_tracker
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any, TypeAlias

from pipeline.dataset import watchdog
from scene.common.errors import InputError, OutsideError
from scene.common.extras import how_to_install

if TYPE_CHECKING:
    from concurrent.futures import Future as StartedFuture

    from distributed import Client, Future, LocalCluster

    from pipeline.dataset.worker import EpochOrder

Run: TypeAlias = "list[EpochOrder]"
"""Epochs that a worker makes in one go."""
_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that limit the threads of numerical libraries."""
_CONNECT_S = 20
"""Time limit of a connection, s."""
_LOOK_S, _LOST_S, _EMPTY_S = 5.0, 15.0, 45.0
"""Interval, s, at which workers are checked; time after which missing local workers, and missing workers of a user's scheduler,
end the job, s.
"""
_CLOSE_S = 20.0
"""Time limit for closing, s."""
_STARTS = 3
"""Number of times that local workers are started if all have died."""
_LONGEST_RUN = 8
"""Largest number of epochs in a run: a killed worker loses at most one run."""
_RUNS_EACH = 2
"""Smallest number of runs for each worker, so that all finish at about the same time."""


def runs(orders: Sequence[EpochOrder], workers: int) -> list[Run]:
    """Divide the epochs of a data set into groups, each of which one worker makes in one go.

    All epochs of a group share wall, sensor and reference epoch, so that these are set up once. Epochs that share them may be
    more than one group, of about equal length, so that all workers have something to do.

    orders: the epochs, those that share a reference next to each other. workers: number of processes.
    """
    longest = min(max(len(orders) // (_RUNS_EACH * workers), 1), _LONGEST_RUN)
    found = []
    for _, same in groupby(orders, key=lambda order: (order.source, order.stage)):
        shared = list(same)
        length = -(-len(shared) // -(-len(shared) // longest))
        found += [shared[start : start + length] for start in range(0, len(shared), length)]
    return found


@dataclass(frozen=True)
class BackgroundWorkers:
    """Local worker processes that a thread starts and ends, so that this process can do other work meanwhile.

    started: the cluster and its client once the workers have started. end: lets the thread end the workers.
    """

    started: StartedFuture[tuple[LocalCluster, Client]]
    end: Callable[[], object]


@contextmanager
def workers_in_background(count: int, modules: Sequence[str]) -> Iterator[BackgroundWorkers]:
    """Start local worker processes in a thread, while this process prepares the work that `map_on_workers` gives them later.

    They have ended when the block ends; `map_on_workers` lets them end once it has all results.

    Parameters
    ----------
    count : Number of workers.
    modules : Names of modules that the workers import at once.

    Raises
    ------
    InputError
        If Dask is not installed.
    """
    _require_distributed("--workers")

    def start() -> tuple[LocalCluster, Client]:
        cluster = _local(stack, count, modules)
        return cluster, _client(stack, cluster)

    with ExitStack() as stack, ThreadPoolExecutor(1) as pool:
        yield BackgroundWorkers(pool.submit(start), lambda: pool.submit(stack.close))


def map_on_workers(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], count: int, workers: BackgroundWorkers | None = None
) -> Iterator[Any]:
    """Call a function with each task's arguments on local worker processes, and yield the results as they finish.

    Parameters
    ----------
    function : Function of a module, which workers import; what it raises is raised here.
    tasks : Arguments of each call.
    count : Number of workers.
    workers : Workers that were started before; None: they are started now.

    Raises
    ------
    InputError
        If Dask is not installed.
    OutsideError
        If workers die repeatedly at one task, or none is left.
    """
    _require_distributed("--workers")
    left = {f"task-{number:06d}": task for number, task in enumerate(tasks)}
    for start in range(1, _STARTS + 1):
        try:
            with ExitStack() as stack:
                if workers is not None and start == 1:
                    cluster, client = workers.started.result()
                else:
                    cluster = _local(stack, min(count, len(left)))
                    client = _client(stack, cluster)
                futures = client.map(_called, [function] * len(left), list(left.values()), key=list(left))
                for future, result in _results(client, futures, cluster):
                    del left[future.key]
                    yield result
            if workers is not None:
                workers.end()
            return
        except _LostError as lost:
            if start == _STARTS:
                raise OutsideError(f"{lost}; finished work is kept, run the same command with --resume to continue") from None


def _called(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    return function(*arguments)


class _LostError(Exception):
    """All workers, or the scheduler, are gone."""


def make_on_cluster(orders: list[EpochOrder], count: int, scheduler: str) -> Iterator[dict[str, Any]]:
    """Make and store epochs of a data set on a Dask cluster, and yield what each took, in the order in which they finish.

    Local workers share the cores. Workers of a scheduler use the threads that Dask gave them, and must see the folder under the
    same path.

    Parameters
    ----------
    orders : The epochs.
    count : Number of local workers.
    scheduler : Address of a Dask scheduler; "": local workers.

    Yields
    ------
    Times, memory and number of tiles of each epoch, as `worker.make_and_store` returns them.

    Raises
    ------
    InputError
        If the scheduler does not answer, or Dask is not installed.
    OutsideError
        If workers die repeatedly at one epoch, or none is left.
    """
    _require_distributed("--scheduler" if scheduler else "--workers")
    starts = 1 if scheduler else _STARTS
    for start in range(1, starts + 1):
        finished: set[int] = set()
        try:
            for number, taken in _make(orders, count, scheduler):
                finished.add(number)
                yield taken
            return
        except _LostError as lost:
            if start == starts:
                raise OutsideError(f"{lost}; finished epochs are kept, run the same command to continue") from None
        orders = [order for number, order in enumerate(orders) if number not in finished]


def _require_distributed(where: str) -> None:
    """Raise InputError if Dask's distributed is not installed."""
    try:
        import cryptography  # noqa: F401
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"the option needs the packages distributed (of Dask) and cryptography ({error})",
            where=where,
            remedy=how_to_install("dataset"),
        ) from None


def _make(orders: list[EpochOrder], count: int, scheduler: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the index in `orders` of each epoch that is done, and what it took."""
    from pipeline.dataset.worker import make_and_store_run  # with the ray tracer, which other users of this module do not need

    with ExitStack() as stack:
        if not scheduler:
            stack.enter_context(watchdog.watch_workers(watchdog.STALLED_S))
        cluster = None if scheduler else _local(stack, count)
        client = _client(stack, cluster) if cluster else _remote(stack, scheduler)
        threads = 0 if scheduler else _threads_each(count)
        index = {(order.source, order.index): number for number, order in enumerate(orders)}
        given = runs([replace(order, threads=threads) for order in orders], count or max(len(client.nthreads()), 1))
        keys = [f"epochs-{run[0].job}-{run[0].source}-{run[0].index:06d}" for run in given]
        run_of = dict(zip(keys, given, strict=True))
        work = partial(watchdog.run_with_watchdog, make_and_store_run, watchdog.STALLED_S) if cluster else make_and_store_run
        for future, taken in _results(client, client.map(work, given, key=keys), cluster):
            for order, each in zip(run_of[future.key], taken, strict=True):
                yield index[order.source, order.index], each


def _results(client: Client, futures: list[Future], cluster: LocalCluster | None) -> Iterator[tuple[Future, Any]]:
    """Yield each future with its result as it finishes, and release it.

    Dask would otherwise repeat the epochs of dead workers.
    """
    from distributed import KilledWorker, wait

    pending, at_work = set(futures), time.monotonic()
    while pending:
        try:
            done = wait(pending, timeout=_LOOK_S, return_when="FIRST_COMPLETED").done
            results = [(future, future.result(timeout=_CONNECT_S)) for future in done]
        except TimeoutError:
            lost, patience = _lost(client, cluster)
            at_work = at_work if lost else time.monotonic()
            if time.monotonic() - at_work > patience:
                raise _LostError(lost) from None
            continue
        except KilledWorker as error:
            remedy = "give each worker at least 2.5 GB of memory and run the same command to continue"
            raise OutsideError(f"workers died while making {error.task}; {remedy}") from None
        except CancelledError:
            raise _LostError("the scheduler is gone") from None
        at_work = time.monotonic()
        for future, taken in results:
            pending.discard(future)
            future.release()
            yield future, taken


def _lost(client: Client, cluster: LocalCluster | None) -> tuple[str, float]:
    """Return who is gone, in words ("": nobody), and how long to wait for it, s: workers of a user's cluster come and go."""
    if cluster:
        return "" if _has_workers(cluster) else "all workers have died", _LOST_S
    try:
        workers = client.sync(client.scheduler.ncores, callback_timeout=_LOOK_S)
    except (OSError, TimeoutError):
        return "the scheduler no longer answers", _LOST_S
    return "" if workers else "the scheduler has no workers", _EMPTY_S


def _has_workers(cluster: LocalCluster) -> bool:
    """Whether the scheduler runs and a worker lives. Dask restarts killed workers, but not one that is killed while starting."""
    return cluster.scheduler.status.name == "running" and any(nanny.is_alive() for nanny in list(cluster.workers.values()))


def _threads_each(count: int) -> int:
    """Return the number of threads for each local worker."""
    return max(1, len(os.sched_getaffinity(0)) // count)


def _local(stack: ExitStack, count: int, modules: Sequence[str] = ()) -> LocalCluster:
    """Start workers on this machine, with one Dask thread each.

    Dask's memory limit is off, because it takes the ray tracer's memory for a leak. modules: names of modules that the workers
    import as they start.
    """
    import dask
    from distributed import LocalCluster, Security

    stack.enter_context(_workers_without_user_script())
    stack.enter_context(
        dask.config.set(
            {
                "distributed.nanny.pre-spawn-environ": dict.fromkeys(_POOLS, str(_threads_each(count))),
                "distributed.worker.memory.spill": False,
                "distributed.scheduler.http.routes": [],  # no pages on the dashboard's server
                "distributed.worker.http.routes": [],
            }
        )
    )
    try:
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=0,
            preload=list(modules),
            loop=stack.enter_context(_loop_without_interrupts()),
            security=Security.temporary(),
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            silence_logs=logging.CRITICAL,
        )
    except (RuntimeError, OSError, TimeoutError) as error:
        raise _LostError(f"the workers did not start ({error})") from None
    stack.callback(_closed, cluster)
    return cluster


@contextmanager
def _workers_without_user_script() -> Iterator[None]:
    """Keep processes that start in this block from running the user's script, which would make the set once more in each of them.

    Spawned processes import the main module by its name or file, but no worker needs anything from it.
    """
    main = sys.modules["__main__"]
    held: dict[str, Any] = {name: vars(main)[name] for name in ("__spec__", "__file__") if name in vars(main)}
    main.__spec__ = None
    vars(main).pop("__file__", None)
    try:
        yield
    finally:
        vars(main).update(held)


def _client(stack: ExitStack, cluster: LocalCluster) -> Client:
    """Connect to the local workers."""
    from distributed import Client

    client = Client(cluster)
    stack.callback(_closed, client)
    return client


@contextmanager
def _loop_without_interrupts() -> Iterator[Any]:
    """Provide an event loop in a thread that ignores Ctrl-C, as do the processes started from it.

    Ctrl-C goes to all processes of a terminal. Only this process handles it and stops the workers, which would else print
    tracebacks.
    """
    from distributed.utils import LoopRunner

    multiprocessing.resource_tracker.ensure_running()  # its start would let interrupts through again
    runner = LoopRunner()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        runner.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield runner.loop
    finally:
        with suppress(TimeoutError):
            runner.stop()


def _closed(each: LocalCluster | Client) -> None:
    """Close a cluster or client, ignoring errors, as the outcome of the job is already known.

    A worker that does not end in time ends with this process. A client that is giving up a connection raises a RuntimeError of
    asyncio, one of a lost scheduler an OSError.
    """
    with suppress(OSError, RuntimeError):
        each.close(timeout=_CLOSE_S)


def _remote(stack: ExitStack, address: str) -> Client:
    """Connect to the user's scheduler.

    For tls://, Dask's own configuration gives the certificates (docs/reference/data_sets.md).
    """
    from distributed import Client

    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"no scheduler answers at '{address}' ({error})",
            where="--scheduler",
            remedy="use the address that the Dask scheduler printed when it started; tls:// also needs "
            "certificates (docs/reference/data_sets.md)",
        ) from None
    stack.callback(_closed, client)
    return client
