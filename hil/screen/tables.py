"""Tables of numbers on a terminal that is too narrow for them, or on none."""

from rich.console import Console
from rich.table import Table


def print_whole(screen: Console, table: Table) -> None:
    """Print with every digit: a line that is too long is the terminal's to wrap, and no number is cut off."""
    wide = screen.measure(table, options=screen.options.update(max_width=10_000)).maximum
    Console(file=screen.file, width=max(screen.width, wide), highlight=False).print(table)
