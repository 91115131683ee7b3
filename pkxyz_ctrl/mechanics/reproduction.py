"""The paper's numbers beside ours: one row for each, with a verdict that is computed from the figures in it.

reproduces        one of the two designs gives the printed number to 0.1 %, or to half a unit of its last digit and
2 % rounded           to one unit of its last digit: cut, or rounded from fewer digits
misprint          neither, but a stated other reading of the text agrees at least ten times better
not reproducible  none of these, or nothing in the lumped model gives the quantity at all
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

from pkxyz_ctrl.stage import Stage


class Verdict(StrEnum):
    """What a comparison comes to."""

    REPRODUCES = "reproduces"
    ROUNDED = "rounded"
    MISPRINT = "misprint"
    NOT_REPRODUCIBLE = "not reproducible"


@dataclass(frozen=True)
class Entry:
    """One number of the paper and how it is computed. Units are the table's, those of the paper."""

    where: str
    quantity: str
    unit: str
    published: str | Callable[[Stage], float]
    """As printed, with its digits; or, for a formula that is itself in question, its value as printed."""
    value: Callable[[Stage], float] | None
    """The same from one design; None where the lumped model has no such thing."""
    why: str
    corrected: Callable[[Stage], tuple[float, float]] | None = None
    """Another reading of the text: (what it then prints, what is computed);
    should be equal if the reading is right.
    """


@dataclass(frozen=True)
class Row:
    """One line of the table. Differences are relative to the published number; None where there is none."""

    where: str
    quantity: str
    unit: str
    published: float
    published_text: str
    printed: float | None
    reconstructed: float | None
    difference_printed: float | None
    difference_reconstructed: float | None
    corrected_from_to: tuple[float, float] | None
    verdict: Verdict
    why: str


def reproduction_table(entries: list[Entry], printed: Stage, reconstructed: Stage) -> list[Row]:
    """All entries evaluated for the two designs."""
    return [_row(entry, printed, reconstructed) for entry in entries]


def verdict(published_text: str, values: list[float], corrected: tuple[float, float] | None = None) -> Verdict:
    """The verdict on a number as printed against what the designs give, and against
    the corrected reading if there is one.
    """
    published = float(published_text)
    unit = 10.0 ** int(Decimal(published_text).as_tuple().exponent)
    for value in sorted(values, key=lambda v: abs(v - published)):
        off = abs(value - published)
        relative = off / abs(published) if published else (0.0 if off <= 1e-12 else math.inf)
        if relative <= 1e-3 or (off <= 0.5 * unit and relative <= 0.02):
            return Verdict.REPRODUCES
        if off <= unit and relative <= 0.1:
            return Verdict.ROUNDED
    if corrected is not None and values and _ten_times_closer(published, values, corrected):
        return Verdict.MISPRINT
    return Verdict.NOT_REPRODUCIBLE


def _ten_times_closer(published: float, values: list[float], corrected: tuple[float, float]) -> bool:
    as_printed = min(_distance(published, value) for value in values)
    return _distance(*corrected) <= 0.1 * as_printed


def _distance(a: float, b: float) -> float:
    """|ln(a/b)|: a factor counts alike in both directions; infinite for numbers of unlike sign."""
    return abs(math.log(a / b)) if a * b > 0 else math.inf


def _row(entry: Entry, printed: Stage, reconstructed: Stage) -> Row:
    text = entry.published if isinstance(entry.published, str) else f"{entry.published(reconstructed):.6g}"
    published = float(text)
    designs = [None if entry.value is None else float(entry.value(stage)) for stage in (printed, reconstructed)]
    corrected = None if entry.corrected is None else entry.corrected(reconstructed)
    # a formula is judged on the design that its literal value was computed from
    judged = designs if isinstance(entry.published, str) else designs[1:]
    decision = verdict(text, [v for v in judged if v is not None], corrected)
    differences = [None if v is None or published == 0 else v / published - 1 for v in designs]
    return Row(
        where=entry.where,
        quantity=entry.quantity,
        unit=entry.unit,
        published=published,
        published_text=text,
        printed=designs[0],
        reconstructed=designs[1],
        difference_printed=differences[0],
        difference_reconstructed=differences[1],
        corrected_from_to=corrected,
        verdict=decision,
        why=entry.why,
    )
