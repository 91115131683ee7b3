"""A bar for long work: on a terminal, on stderr, and gone when the work is done."""

import mmap
import os
import signal
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from hil.screen.terminal import notes


class Tell(Protocol):
    """Says how much is done, and of how much; and, where that changes, at what."""

    def __call__(self, done: int, total: int, words: str | None = None, /) -> None: ...


@contextmanager
def progress_bar(words: str, *, quiet: bool, still: bool = False) -> Iterator[Tell]:
    """Gives the function that is to be told. ``quiet``, or no terminal: no bar. ``still``: it is redrawn only where it
    is told something, without a thread beside what is being measured.
    """
    if quiet or not notes().is_terminal:
        yield lambda done, total, words=None, /: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=notes(), transient=True, auto_refresh=not still) as progress:
        task = progress.add_task(words, total=None)
        yield lambda done, total, words=None, /: progress.update(
            task, completed=done, total=total, description=words, refresh=still
        )


_DONE_OF = struct.Struct("qq")
_REDRAWN_S = 0.2


@contextmanager
def bar_apart(words: str, *, quiet: bool) -> Iterator[Tell]:
    """As ``progress_bar``, for a loop at rate: a process of its own draws, and to tell it takes a microsecond.

    Forks: to be entered before buses are opened and priorities raised.
    """
    if quiet or not notes().is_terminal:
        yield lambda done, total, words=None, /: None
        return
    told = mmap.mmap(-1, _DONE_OF.size)
    child = os.fork()
    if child == 0:
        _draw_until_ended(words, told)
    try:
        yield lambda done, total, words=None, /: _DONE_OF.pack_into(told, 0, done, total)
    finally:
        os.kill(child, signal.SIGTERM)
        os.waitpid(child, 0)


def _draw_until_ended(words: str, told: mmap.mmap) -> None:
    """Never returns: whoever started it ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit())
    parent = os.getppid()
    try:
        with progress_bar(words, quiet=False, still=True) as tell:
            while os.getppid() == parent:
                done, total = _DONE_OF.unpack_from(told, 0)
                if total:
                    tell(done, total)
                time.sleep(_REDRAWN_S)
    finally:
        os._exit(0)
