"""Independent work in pieces, spread over the cores of this machine or over a Dask cluster.

The pieces are calls of one function with plain arguments; results come as they are done. Each process keeps to one
thread, so that as many processes as cores don't get into each other's way.
"""

import os
import pickle
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import Any, TypeVar, cast

from hil.studies.spread.cluster import Cluster
from hil.studies.spread.processes import processes
from pkxyz_ctrl.config.files import ConfigError

Item = TypeVar("Item")
Result = TypeVar("Result")

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def worker_pool(workers: int, cluster: Cluster | None = None) -> Iterator[tuple[Executor, int]]:
    """An executor and how many pieces it can work at: processes here, or the threads of a Dask cluster.

    Raises ``ConfigError`` for a scheduler that doesn't answer or has no workers.
    """
    if cluster is None:
        before = {name: os.environ.get(name) for name in _THREADS}
        os.environ.update(dict.fromkeys(_THREADS, "1"))  # read by the libraries when a process starts
        try:
            with processes(workers) as pool:
                yield pool, workers
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        return
    try:
        from distributed import Client as Connect
    except ImportError:
        raise ConfigError("--dask needs the package 'distributed'; install this one with its extra [cluster]") from None
    try:
        client: Any = cast(Any, Connect)(
            cluster.address, timeout="10s", set_as_default=False, security=cluster.security
        )
    except (OSError, ValueError) as error:
        raise ConfigError(f"--dask: no scheduler answers at {cluster.address}: {error}") from None
    with client:
        threads = sum(client.nthreads().values())
        if threads == 0:
            raise ConfigError(
                f"--dask: the scheduler at {cluster.address} has no workers; start some with 'dask worker'"
            )
        yield client.get_executor(pure=False), threads


def with_constant(function: Callable[[Any, Item], Result], constant: object) -> Callable[[Item], Result]:
    """``function`` with its first argument, for ``as_done``: each process unpacks it once and keeps it, with all that
    it has worked out about it.
    """
    return partial(_on_unpacked, function, pickle.dumps(constant))


def _on_unpacked(function: Callable[[Any, Item], Result], packed: bytes, item: Item) -> Result:
    return function(_unpacked(packed), item)


@lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> object:
    return pickle.loads(packed)


def as_done(
    pool: Executor, width: int, function: Callable[[Item], Result], items: Iterable[Item], *, ahead: int = 0
) -> Iterator[tuple[Item, Result]]:
    """(item, function(item)) in the order in which they are done. Items are taken from their iterator as workers
    get free, so an iterator may look at the results so far. What a call raises is raised here.

    ``ahead``: how many items more are handed out than there are workers, so that none waits for this process; for
    iterators that don't look.
    """
    waiting: dict[Future[Result], Item] = {}
    source, more = iter(items), True
    while waiting or more:
        while more and len(waiting) < width + ahead:
            try:
                item = next(source)
            except StopIteration:
                more = False
                break
            waiting[pool.submit(function, item)] = item
        if not waiting:
            return
        done, _ = wait(waiting, return_when=FIRST_COMPLETED)
        for future in sorted(done, key=lambda f: list(waiting).index(f)):
            yield waiting.pop(future), future.result()
