"""The epochs of a set on Dask's distributed: local processes, or the scheduler at an address. Queue and retries are Dask's."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

from pipeline.dataset.worker import Order, fill_run
from scene.errors import InputError

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_CONNECT_S = 20
_LONGEST_RUN = 8
"""Epochs that a worker makes before it reports; what a killed worker costs at most."""
_RUNS_EACH = 2
"""For each worker at least, so that the last to finish is not far behind."""


def runs(orders: Sequence[Order], workers: int) -> list[list[Order]]:
    """Orders in runs of neighbours that share a stage, which a worker then sets up once; of equal lengths within a stage."""
    longest = min(max(len(orders) // (_RUNS_EACH * workers), 1), _LONGEST_RUN)
    found = []
    for _, same in groupby(orders, key=lambda order: (order.source, order.stage)):
        shared = list(same)
        length = -(-len(shared) // -(-len(shared) // longest))
        found += [shared[start : start + length] for start in range(0, len(shared), length)]
    return found


def fill_on_cluster(orders: list[Order], count: int, scheduler: str) -> Iterator[dict[str, Any]]:
    """What each order took, in the order in which they are done; count: local workers, or scheduler: an address.

    Local workers share the cores; those of a scheduler have as many threads as Dask gave them, and must see the folder under the
    same path. Raises InputError for a scheduler that does not answer, and for an epoch whose workers die again and again.
    """
    try:
        from distributed import KilledWorker, as_completed
    except ImportError:
        where, remedy = "--scheduler" if scheduler else "--workers", "install it: pip install 'scarpsim[dataset]'"
        raise InputError("needs Dask's distributed, which is not installed", where=where, remedy=remedy) from None
    with ExitStack() as stack:
        client = _remote(stack, scheduler) if scheduler else _local(stack, count)
        threads = 0 if scheduler else _threads_each(count)
        given = runs([replace(order, threads=threads) for order in orders], count or max(len(client.nthreads()), 1))
        keys = [f"epochs-{run[0].job}-{run[0].source}-{run[0].index:06d}" for run in given]
        try:
            # nobody keeps the futures: Dask would make the epochs of a dead worker again for the sake of its results
            for future, taken in as_completed(client.map(fill_run, given, key=keys), with_results=True):
                future.release()
                yield from taken
        except KilledWorker as error:
            raise InputError(
                f"workers died while making {error.task}", where="dataset", remedy="see that each has 2.5 GB of memory or more"
            ) from None


def _threads_each(count: int) -> int:
    return max(1, len(os.sched_getaffinity(0)) // count)


def _local(stack: ExitStack, count: int) -> Client:
    """Workers on this machine, one thread of Dask's each. Dask's memory limit is off: it takes the ray tracer's for a leak."""
    import dask
    from distributed import Client, LocalCluster

    pools = dict.fromkeys(_POOLS, str(_threads_each(count)))
    stack.enter_context(dask.config.set({"distributed.nanny.pre-spawn-environ": pools, "distributed.worker.memory.spill": False}))
    cluster = LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        memory_limit=0,
        dashboard_address=None,
        silence_logs=logging.CRITICAL,
    )
    stack.callback(_closed, cluster)
    return stack.enter_context(Client(cluster))


def _closed(cluster: LocalCluster) -> None:
    """Stop the workers. One that does not end in time, on a busy machine, ends with this process; its epochs are made."""
    with suppress(TimeoutError):
        cluster.close()


def _remote(stack: ExitStack, address: str) -> Client:
    from distributed import Client

    try:
        return stack.enter_context(Client(address, timeout=_CONNECT_S))
    except (OSError, ValueError) as error:
        raise InputError(
            f"no scheduler answers at '{address}' ({error})", where="--scheduler", remedy="give the address that it printed"
        ) from None
