"""``pkxyz bench``: the table on a terminal, or JSON."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.screen.progress import progress_bar
from hil.screen.terminal import bad, good, notes, plain_table, screen

if TYPE_CHECKING:
    from rich.table import Table

    from hil.bench.rigs.figure import Figure

_WIDE = 120
"""Columns of a terminal from which on there is room for what a figure means."""
_COLUMNS = (("figure", "left"), ("best", "right"), ("median", "right"), ("", "left"), ("target", "left"), ("", "left"))


def bench(
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A measurement (tick, lockstep, ...) or a figure of one; may be repeated."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON, and nothing else.")] = False,
) -> None:
    """Measure how fast and how well everything works here; takes about a minute. A missed target is no error."""
    from hil.bench.suite import describe_machine, results

    machine = describe_machine()  # its load before we add to it
    figures = measure_all(only or [], quiet=as_json)
    if as_json:
        print(json.dumps(results(machine, figures), allow_nan=False))
    else:
        screen().print(table_of(figures, with_details=screen().width >= _WIDE))


def measure_all(only: list[str], *, quiet: bool) -> "list[Figure]":
    """Take the measurements one after the other, with progress on a terminal. Raises ``ConfigError`` for bad names."""
    from hil.bench.suite import chosen, measure

    names = chosen(only)
    _say_if_compiling(quiet=quiet)
    figures = []
    with progress_bar("", quiet=quiet, still=True) as tell:
        for n, name in enumerate(names):
            tell(n, len(names), name)
            figures += measure(name, only)
    return figures


def _say_if_compiling(*, quiet: bool) -> None:
    from hil.bench.rigs.kernels import replay_cycle

    cache = getattr(replay_cycle, "_cache", None)  # absent when the compiler is switched off
    if not quiet and cache is not None and not any(Path(cache.cache_path).glob("kernels.replay_cycle-*.nbi")):
        notes().print("First run here: the kernels are compiled as they are needed, which takes a minute or two.")


def table_of(figures: "list[Figure]", *, with_details: bool) -> "Table":
    """A row for each figure, with a blank between measurements."""
    table = plain_table()
    table.show_header = True
    for heading, side in _COLUMNS:
        table.add_column(heading, justify=side, no_wrap=True)  # type: ignore[arg-type]
    if with_details:
        table.add_column("", style="dim", overflow="fold")
    group = ""
    for figure in figures:
        if group and figure.name.partition(".")[0] != group:
            table.add_row()
        group = figure.name.partition(".")[0]
        verdict = {True: good("met"), False: bad("missed"), None: ""}[figure.met]
        median = "" if figure.median is None else in_digits(figure.median)
        cells: tuple[Any, ...] = (figure.name, in_digits(figure.value), median, figure.unit, bound_of(figure), verdict)
        table.add_row(*cells, *((figure.detail,) if with_details else ()))
    return table


def in_digits(value: float) -> str:
    """Three digits, without an exponent."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def bound_of(figure: "Figure") -> str:
    """The target in words, empty without one."""
    return "" if figure.target is None else f"{figure.direction} {figure.target:g}"
