"""What a check says: one line of the report."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil.conformance.talker import Talker


class Verdict(StrEnum):
    PASS = "PASS"
    FAIL = "FAIL"
    NOT_TESTED = "NOT TESTED"


class DeviationError(Exception):
    """The node did something else than expected; the text says what came."""


class NotTestedError(Exception):
    """The check could not be made; the text says why. Not a verdict on the node."""


@dataclass(frozen=True)
class Check:
    """One line. ``perform`` returns what came, or raises one of the two above."""

    group: str
    name: str
    expected: str
    perform: "Callable[[Talker], str]"


@dataclass(frozen=True)
class Line:
    """The outcome of a check."""

    group: str
    name: str
    verdict: Verdict
    expected: str
    got: str


def judge(check: Check, talker: "Talker") -> Line:
    """Make one check."""
    try:
        verdict, got = Verdict.PASS, check.perform(talker)
    except DeviationError as deviation:
        verdict, got = Verdict.FAIL, str(deviation)
    except NotTestedError as reason:
        verdict, got = Verdict.NOT_TESTED, str(reason)
    return Line(check.group, check.name, verdict, check.expected, got)


def first_few(deviations: list[str], limit: int = 6) -> str:
    """A list for one line of a report."""
    more = len(deviations) - limit
    return "; ".join(deviations[:limit]) + (f"; and {more} more" if more > 0 else "")


def deviate_if(deviations: list[str]) -> None:
    """Raise ``DeviationError`` if there is anything in the list."""
    if deviations:
        raise DeviationError(first_few(deviations))
