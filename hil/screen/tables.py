"""Tables of numbers on a terminal that is too narrow for them, or on none."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.table import Table


def print_whole(screen: Console, table: Table) -> None:
    """Print with every digit: a line that is too long is the terminal's to wrap, and no number is cut off."""
    wide = screen.measure(table, options=screen.options.update(max_width=10_000)).maximum
    Console(file=screen.file, width=max(screen.width, wide), highlight=False).print(table)


def error_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """A line for each figure of three axes that every run has: error while scanning, and noise in holds."""
    by = ", by the estimate" if summary.get("errors_are_of") == "estimate" else ""
    for name, words in (("rms_error_nm", "rms error while scanning"), ("hold_noise_nm", "rms noise in holds")):
        if summary[name]:
            yield f"{words}{by}, x / y / z: {' / '.join(f'{value:.2f}' for value in summary[name].values())} nm"
