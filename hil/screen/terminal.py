"""The terminal. What is printed are words: nothing in them is markup, whatever brackets a file name or a fault has."""

import sys
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text


@cache
def screen() -> "Console":
    """Standard output: results."""
    from rich.console import Console

    return Console(highlight=False, markup=False, emoji=False)


@cache
def notes() -> "Console":
    """Standard error: what is said besides."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, markup=False, emoji=False)


def say(*words: "str | Text") -> None:
    """A line of the result, as long as it is; pieces are joined without a blank."""
    screen().print(*words, sep="", soft_wrap=True)


def note(words: str) -> None:
    """A line on standard error, at once."""
    print(words, file=sys.stderr, flush=True)


def good(words: str) -> "Text":
    """What holds."""
    return _styled(words, "green")


def bad(words: str) -> "Text":
    """What does not."""
    return _styled(words, "bold red")


def faint(words: str) -> "Text":
    """What says nothing either way."""
    return _styled(words, "dim")


def _styled(words: str, style: str) -> "Text":
    from rich.text import Text

    return Text(words, style=style)


def warned(words: str) -> "Text":
    """What holds with a reservation."""
    return _styled(words, "yellow")


def plain_table(*headings: str, left: tuple[str, ...] = (), title: str | None = None) -> "Table":
    """A table without lines: numbers stand to the right, the first column and those headed as in ``left`` to the left.

    Without headings its columns come with its rows.
    """
    from rich.table import Table

    table = Table(
        box=None, pad_edge=False, header_style="dim", title=title, title_justify="left", show_header=bool(headings)
    )
    for n, heading in enumerate(headings):
        table.add_column(heading, justify="right" if n and heading not in left else "left")
    return table


def print_whole(table: "Table") -> None:
    """Print with every digit: a line that is too long is the terminal's to wrap, and no number is cut off."""
    from rich.console import Console

    to = screen()
    wide = to.measure(table, options=to.options.update(max_width=10_000)).maximum
    Console(file=to.file, width=max(to.width, wide), highlight=False, markup=False, emoji=False).print(table)
