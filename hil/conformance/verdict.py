"""What a check says: one line of the report."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from hil.conformance.deviation import DeviationError, NotTestedError
from hil.conformance.talker import Talker


class Verdict(StrEnum):
    PASS = "PASS"
    FAIL = "FAIL"
    NOT_TESTED = "NOT TESTED"


@dataclass(frozen=True)
class Check:
    """One line. ``perform`` returns what came, or raises ``DeviationError`` or ``NotTestedError``."""

    group: str
    name: str
    expected: str
    perform: Callable[[Talker], str]


@dataclass(frozen=True)
class Line:
    """The outcome of a check."""

    group: str
    name: str
    verdict: Verdict
    expected: str
    got: str


def judge(check: Check, talker: Talker) -> Line:
    """Make one check."""
    try:
        verdict, got = Verdict.PASS, check.perform(talker)
    except DeviationError as deviation:
        verdict, got = Verdict.FAIL, str(deviation)
    except NotTestedError as reason:
        verdict, got = Verdict.NOT_TESTED, str(reason)
    return Line(check.group, check.name, verdict, check.expected, got)
