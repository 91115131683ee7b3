"""Processes for independent work, which Ctrl-C ends at once and without a word of theirs: they hold nothing to save."""

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager


@contextmanager
def processes(workers: int | None) -> Iterator[ProcessPoolExecutor]:
    """An executor over processes (None: one for each core). Left by an exception, nothing more is begun or finished."""
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    before = multiprocessing.active_children()
    with _ctrl_c_unheard():
        pool.submit(int)  # the first call starts them all
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            if child not in before:
                child.terminate()
        raise
    pool.shutdown()


@contextmanager
def _ctrl_c_unheard() -> Iterator[None]:
    """A process that is started inside never hears Ctrl-C, from its first instruction on."""
    try:
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not in the main thread, where nobody hears it either
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
