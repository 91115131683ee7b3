"""Processes for independent work, which Ctrl-C ends at once and without a word of theirs: they hold nothing to save."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

from pkxyz_ctrl.io.realtime import cores


@contextmanager
def processes(workers: int | None) -> Iterator[ProcessPoolExecutor]:
    """An executor over processes, one for each core if None. Left by an exception, nothing more is begun or finished;
    nor is it if this process is killed.
    """
    workers = workers or cores()
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_end_with_the_parent)
    before = multiprocessing.active_children()
    try:
        with ctrl_c_kept_back():
            for _ in range(workers):
                pool.submit(int)  # each starts one, as none is idle yet
        yield pool
    except BaseException:
        for child in multiprocessing.active_children():
            if child not in before:
                child.terminate()
        raise  # what waits is not cancelled: the executor finds itself broken, fails all of it and tidies up
    finally:
        pool.shutdown()


@contextmanager
def ctrl_c_kept_back() -> Iterator[None]:
    """A process that is started inside never hears Ctrl-C, from its first instruction on; this one hears it later.

    The mask is for the child, which inherits it. It keeps nothing from this process as long as another thread may take
    the signal: Python answers in the main thread whichever took it. So the answer, too, waits.
    """
    heard: list[int] = []
    answer = signal.getsignal(signal.SIGINT)
    answers_here = threading.current_thread() is threading.main_thread() and answer is not None
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    if answers_here:
        signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, masked)
        if answers_here:
            signal.signal(signal.SIGINT, answer)
        if heard:
            signal.raise_signal(signal.SIGINT)


def _end_with_the_parent() -> None:
    """In a process of the executor: not to wait for ever for one that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_follow, args=(parent,), daemon=True).start()


def _follow(parent: "multiprocessing.process.BaseProcess") -> None:
    parent.join()
    os._exit(1)
