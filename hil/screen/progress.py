"""A bar for long work: on a terminal, on stderr, and gone when the work is done."""

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
