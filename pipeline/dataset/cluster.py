"""The epochs of a set on Dask's distributed: local processes, or the scheduler at an address. Queue and retries are Dask's.

Local processes speak TLS with keys that exist in memory for one job alone, so that no other user of the machine can hand them
work; there is no dashboard. A scheduler of the user's is as open or closed as the user set it up.
"""

from __future__ import annotations

import logging
import multiprocessing.resource_tracker
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any

from pipeline.dataset import standstill
from pipeline.dataset.worker import Order, fill_run
from scene.common.errors import InputError, OutsideError
from scene.common.extras import how_to_install

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

Run = list[Order]
_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_CONNECT_S = 20
_LOOK_S, _LOST_S, _EMPTY_S = 5.0, 15.0, 45.0
"""How often it is asked who works, how long nobody may, and how long a scheduler of the user's may have no workers."""
_CLOSE_S = 20.0
_STARTS = 3
"""Times that local workers are started, all of which died."""
_LONGEST_RUN = 8
"""Epochs that a worker makes before it reports; what a killed worker costs at most."""
_RUNS_EACH = 2
"""For each worker at least, so that the last to finish is not far behind."""


def runs(orders: Sequence[Order], workers: int) -> list[Run]:
    """Orders in runs of neighbours that share a stage, which a worker then sets up once; of equal lengths within a stage."""
    longest = min(max(len(orders) // (_RUNS_EACH * workers), 1), _LONGEST_RUN)
    found = []
    for _, same in groupby(orders, key=lambda order: (order.source, order.stage)):
        shared = list(same)
        length = -(-len(shared) // -(-len(shared) // longest))
        found += [shared[start : start + length] for start in range(0, len(shared), length)]
    return found


class _LostError(Exception):
    """All workers, or the scheduler, are gone."""


def fill_on_cluster(orders: list[Order], count: int, scheduler: str) -> Iterator[dict[str, Any]]:
    """What each order took, in the order in which they are done; count: local workers, or scheduler: an address.

    Local workers share the cores; those of a scheduler have as many threads as Dask gave them, and must see the folder under the
    same path. Raises InputError for a scheduler that does not answer; OutsideError for an epoch whose workers die again and
    again, and where nobody is left to work.
    """
    _require_distributed("--scheduler" if scheduler else "--workers")
    starts = 1 if scheduler else _STARTS
    for start in range(1, starts + 1):
        finished: set[int] = set()
        try:
            for number, taken in _fill(orders, count, scheduler):
                finished.add(number)
                yield taken
            return
        except _LostError as lost:
            if start == starts:
                raise OutsideError(f"{lost}; what was finished is kept, the same command goes on") from None
        orders = [order for number, order in enumerate(orders) if number not in finished]


def _require_distributed(where: str) -> None:
    try:
        import cryptography  # noqa: F401
        import distributed  # noqa: F401
    except ImportError as error:
        problem = f"needs Dask's distributed and cryptography ({error})"
        raise InputError(problem, where=where, remedy=how_to_install("dataset")) from None


def _fill(orders: list[Order], count: int, scheduler: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """The index in `orders` of each that is done, and what it took."""
    with ExitStack() as stack:
        if not scheduler:
            stack.enter_context(standstill.workers_watched(standstill.STUCK_S))
        cluster = None if scheduler else _local(stack, count)
        client = _client(stack, cluster) if cluster else _remote(stack, scheduler)
        threads = 0 if scheduler else _threads_each(count)
        index = {(order.source, order.index): number for number, order in enumerate(orders)}
        given = runs([replace(order, threads=threads) for order in orders], count or max(len(client.nthreads()), 1))
        keys = [f"epochs-{run[0].job}-{run[0].source}-{run[0].index:06d}" for run in given]
        run_of = dict(zip(keys, given, strict=True))
        work = partial(standstill.unless_stuck, fill_run, standstill.STUCK_S) if cluster else fill_run
        for future, taken in _results(client, client.map(work, given, key=keys), cluster):
            for order, each in zip(run_of[future.key], taken, strict=True):
                yield index[order.source, order.index], each


def _results(
    client: Client, futures: list[Future], cluster: LocalCluster | None
) -> Iterator[tuple[Future, list[dict[str, Any]]]]:
    """Each future with its result as it is done; nobody keeps it, as Dask would make the epochs of a dead worker again for it."""
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
            remedy = "see that each has 2.5 GB of memory or more, then the same command goes on"
            raise OutsideError(f"workers died while making {error.task}; {remedy}") from None
        except CancelledError:
            raise _LostError("the scheduler is gone") from None
        at_work = time.monotonic()
        for future, taken in results:
            pending.discard(future)
            future.release()
            yield future, taken


def _lost(client: Client, cluster: LocalCluster | None) -> tuple[str, float]:
    """Who is gone, in words ("": nobody), and how long that may be so, s: workers of a user's cluster come and go."""
    if cluster:
        return "" if _has_workers(cluster) else "all workers have died", _LOST_S
    try:
        workers = client.sync(client.scheduler.ncores, callback_timeout=_LOOK_S)
    except (OSError, TimeoutError):
        return "the scheduler does not answer any more", _LOST_S
    return "" if workers else "the scheduler has no workers", _EMPTY_S


def _has_workers(cluster: LocalCluster) -> bool:
    """Whether the scheduler runs and a worker's process lives; Dask starts killed ones again, but not one killed at its start."""
    return cluster.scheduler.status.name == "running" and any(nanny.is_alive() for nanny in list(cluster.workers.values()))


def _threads_each(count: int) -> int:
    return max(1, len(os.sched_getaffinity(0)) // count)


def _local(stack: ExitStack, count: int) -> LocalCluster:
    """Workers on this machine, one thread of Dask's each. Dask's memory limit is off: it takes the ray tracer's for a leak."""
    import dask
    from distributed import LocalCluster, Security

    stack.enter_context(_script_kept_from_workers())
    stack.enter_context(
        dask.config.set(
            {
                "distributed.nanny.pre-spawn-environ": dict.fromkeys(_POOLS, str(_threads_each(count))),
                "distributed.worker.memory.spill": False,
                "distributed.scheduler.http.routes": [],  # what is left of the dashboard's server tells nothing
                "distributed.worker.http.routes": [],
            }
        )
    )
    try:
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=0,
            loop=stack.enter_context(_deaf_loop()),
            security=Security.temporary(),
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            silence_logs=logging.CRITICAL,
        )
    except (RuntimeError, OSError, TimeoutError) as error:
        raise _LostError(f"the workers do not start ({error})") from None
    stack.callback(_closed, cluster)
    return cluster


@contextmanager
def _script_kept_from_workers() -> Iterator[None]:
    """Within it new processes do not run the user's script, which would make the set once more in each of them.

    Processes that are spawned import the main module by its name or file; nothing that a worker does is in it.
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
    from distributed import Client

    client = Client(cluster)
    stack.callback(_closed, client)
    return client


@contextmanager
def _deaf_loop() -> Iterator[Any]:
    """An event loop in a thread that no interrupt reaches, nor the processes that are started from it.

    A Ctrl-C goes to all processes of a terminal; this one hears it and stops the workers, each of which would print a traceback.
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
    """Stop it; the outcome is known, so that nothing that goes wrong here may take its place.

    A worker that does not end in time, on a busy machine, ends with this process. A client that is just giving up a connection
    fails with a RuntimeError of asyncio's timeouts, that of a scheduler that is gone with an OSError.
    """
    with suppress(OSError, RuntimeError):
        each.close(timeout=_CLOSE_S)


def _remote(stack: ExitStack, address: str) -> Client:
    """The user's scheduler; for tls:// Dask takes the certificates from its own configuration (docs/reference/data_sets.md)."""
    from distributed import Client

    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"no scheduler answers at '{address}' ({error})",
            where="--scheduler",
            remedy="give the address that it printed, and for tls:// the certificates (docs/reference/data_sets.md)",
        ) from None
    stack.callback(_closed, client)
    return client
