"""What a check says: one line of the report."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from hil.conformance.deviation import DeviationError, NotTestedError, UndecidedError
from hil.conformance.talker import Talker

SAFETY = "safety"
"""A device may be destroyed if this is not so."""
OUR_CONTRACT = "our contract"
"""Of ``configs/comb_amplifier.eds`` and the bus file; another amplifier may do otherwise and be a good one."""

_ATTEMPTS = 3


class Verdict(StrEnum):
    PASS = "PASS"
    UNSAFE = "UNSAFE"
    AGAINST_CIA = "AGAINST CIA"
    OTHER_CONTRACT = "OTHER CONTRACT"
    MEASURE = "MEASURE"
    NOT_TESTED = "NOT TESTED"


DEVIATIONS = (Verdict.UNSAFE, Verdict.AGAINST_CIA, Verdict.OTHER_CONTRACT, Verdict.MEASURE)


@dataclass(frozen=True)
class Check:
    """One line. ``perform`` returns what came, or raises one of the errors of ``deviation``.

    ``basis``: what a deviation is against: ``SAFETY``, ``OUR_CONTRACT``, or a clause of CiA's. ``is_timed``: whether a
    tester that is late itself can make a good node look bad.
    """

    group: str
    name: str
    expected: str
    basis: str
    perform: Callable[[Talker], str]
    is_timed: bool = True


@dataclass(frozen=True)
class CheckResult:
    """The result of a check."""

    group: str
    name: str
    verdict: Verdict
    expected: str
    basis: str
    got: str


def judge(check: Check, talker: Talker) -> CheckResult:
    """Make one check. One that deviates while this very machine was late is made again, and after that not counted."""
    for _ in range(_ATTEMPTS):
        talker.late_us = 0
        verdict, got = _outcome(check, talker)
        if verdict not in DEVIATIONS or not check.is_timed or not talker.was_late:
            break
    else:
        verdict, got = Verdict.NOT_TESTED, f"this machine itself was {talker.late_us / 1000:.1f} ms late: {got}"
    return CheckResult(check.group, check.name, verdict, check.expected, check.basis, got)


def _outcome(check: Check, talker: Talker) -> tuple[Verdict, str]:
    try:
        return Verdict.PASS, check.perform(talker)
    except DeviationError as deviation:
        if deviation.is_unsafe or check.basis == SAFETY:
            return Verdict.UNSAFE, str(deviation)
        return (Verdict.OTHER_CONTRACT if check.basis == OUR_CONTRACT else Verdict.AGAINST_CIA), str(deviation)
    except UndecidedError as question:
        return Verdict.MEASURE, str(question)
    except NotTestedError as reason:
        return Verdict.NOT_TESTED, str(reason)
