"""Independent work in pieces, spread over the cores of this machine or over a Dask cluster.

The pieces are calls of one function with plain arguments; results come as they are done. Each process keeps to one
thread, so that as many processes as cores don't get into each other's way.
"""

import os
import pickle
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from typing import Any, Protocol, TypeVar, cast

from hil.studies.spread.cluster import Cluster
from hil.studies.spread.processes import processes
from pkxyz_ctrl.config.files import ConfigError

Item = TypeVar("Item")
Result = TypeVar("Result")

DEATHS_AT_MOST = 3
"""Of workers without a result between them: what each of them was at is done anew."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class Pool(Protocol):
    """Takes pieces of work."""

    def submit(self, function: Callable[[Item], Result], item: Item, /) -> Future[Result]:
        """Begin one."""
        ...


class LocalPool:
    """Processes here. One that is killed breaks them all, and others take their place when they are asked to."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._holds = ExitStack()
        self._pool: Executor = self._holds.enter_context(processes(workers))

    def submit(self, function: Callable[[Item], Result], item: Item, /) -> Future[Result]:
        """Begin a piece. Raises ``BrokenExecutor`` until ``renew``, if one of the processes was killed."""
        return self._pool.submit(function, item)

    def renew(self) -> None:
        """Begin again with processes that are whole."""
        self._holds.close()
        self._pool = self._holds.enter_context(processes(self._workers))

    def __enter__(self) -> "LocalPool":
        return self

    def __exit__(self, *error: Any) -> None:
        self._holds.__exit__(*error)


@contextmanager
def worker_pool(workers: int, cluster: Cluster | None = None) -> Iterator[tuple[Pool, int]]:
    """What works, and how many pieces it can work at: processes here, or the threads of a Dask cluster.

    Raises ``ConfigError`` for a scheduler that doesn't answer or has no workers, and where they die again and again.
    """
    with _processes(workers) if cluster is None else _dask(cluster) as pool:
        yield pool


@contextmanager
def _processes(workers: int) -> Iterator[tuple[Pool, int]]:
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read by the libraries when a process starts
    try:
        with LocalPool(workers) as pool:
            yield pool, workers
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


@contextmanager
def _dask(cluster: Cluster) -> Iterator[tuple[Pool, int]]:
    try:
        from distributed import Client as Connect
        from distributed import KilledWorker
    except ImportError:
        raise ConfigError(
            "--cluster needs the package 'distributed'; install this one with its extra [cluster]"
        ) from None
    try:
        client: Any = cast(Any, Connect)(
            cluster.address, timeout="10s", set_as_default=False, security=cluster.security
        )
    except (OSError, ValueError) as error:
        raise ConfigError(f"--cluster: no scheduler answers at {cluster.address}: {error}") from None
    with client:
        threads = sum(client.nthreads().values())
        if threads == 0:
            raise ConfigError(
                f"--cluster: the scheduler at {cluster.address} has no workers; start some with 'dask worker'"
            )
        try:
            yield client.get_executor(pure=False), threads
        except KilledWorker as error:  # the scheduler gives a piece to another worker, but not for ever
            raise ConfigError(f"--cluster: workers at {cluster.address} died at the same piece: {error}") from None


def with_constant(function: Callable[[Any, Item], Result], constant: object) -> Callable[[Item], Result]:
    """``function`` with its first argument, for ``as_done``: each process unpacks it once and keeps it, with all that
    it has worked out about it.
    """
    return partial(_on_unpacked, function, pickle.dumps(constant))


def packed_bytes(carried: object) -> int:
    """How much crosses to another process, or back."""
    return len(pickle.dumps(carried))


def _on_unpacked(function: Callable[[Any, Item], Result], packed: bytes, item: Item) -> Result:
    return function(_unpacked(packed), item)


@lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> object:
    return pickle.loads(packed)


def as_done(
    pool: Pool, width: int, function: Callable[[Item], Result], items: Iterable[Item], *, ahead: int = 0
) -> Iterator[tuple[Item, Result]]:
    """(item, function(item)) in the order in which they are done, each once. Items are taken from their iterator as
    workers get free, so an iterator may look at the results so far. What a call raises is raised here. What a killed
    process was at is begun again.

    ``ahead``: how many items more are handed out than there are workers, so that none waits for this process; for
    iterators that don't look. Raises ``ConfigError`` where processes are killed again and again.
    """
    waiting: dict[Future[Result], Item] = {}
    source, more, deaths = iter(items), True, 0
    while waiting or more:
        while more and len(waiting) < width + ahead:
            try:
                item = next(source)
            except StopIteration:
                more = False
                break
            waiting[_begun(pool, function, item)] = item
        if not waiting:
            return
        done, _ = wait(waiting, return_when=FIRST_COMPLETED)
        if isinstance(pool, LocalPool) and any(isinstance(f.exception(), BrokenExecutor) for f in done):
            deaths += 1
            if deaths > DEATHS_AT_MOST:
                raise ConfigError(
                    f"worker processes were killed {deaths} times without a result between; too little memory, say: "
                    "give fewer --workers"
                )
            pool.renew()
            waiting = {
                future if _is_whole(future) else pool.submit(function, item): item for future, item in waiting.items()
            }
            continue
        for future in sorted(done, key=lambda f: list(waiting).index(f)):
            deaths = 0
            yield waiting.pop(future), future.result()


def _begun(pool: Pool, function: Callable[[Item], Result], item: Item) -> Future[Result]:
    """A piece that is begun; where the pool was found broken meanwhile, one that says so."""
    try:
        return pool.submit(function, item)
    except BrokenExecutor as error:
        broken: Future[Result] = Future()
        broken.set_exception(error)
        return broken


def _is_whole(future: "Future[Any]") -> bool:
    """Whether it has a result, or an error of its own."""
    return future.done() and not isinstance(future.exception(), BrokenExecutor)
