"""The conformance run: all checks in order, and what they amount to."""

from collections.abc import Callable, Iterator

from hil.conformance import digital, network, objects, outputs, process
from hil.conformance.talker import Talker
from hil.conformance.verdict import Check, CheckResult, Verdict, judge

CHECKS: tuple[Check, ...] = (
    objects.ANSWERS, *objects.CHECKS, *network.CHECKS, *process.CHECKS, *outputs.CHECKS, *digital.CHECKS,
)  # fmt: skip


def conformance(talker: Talker, checks: tuple[Check, ...] = CHECKS) -> Iterator[CheckResult]:
    """Line by line, as they are made. A node that does not answer at all is asked nothing more."""
    silent = False
    for check in checks:
        if silent:
            yield CheckResult(
                check.group, check.name, Verdict.NOT_TESTED, check.expected, check.basis, "the node does not answer SDO"
            )
            continue
        line = judge(check, talker)
        silent = check is objects.ANSWERS and line.verdict is not Verdict.PASS
        yield line


def run_all(talker: Talker, told: Callable[[CheckResult], None] = lambda line: None) -> list[CheckResult]:
    """All lines; ``told`` hears of each as it comes. At the end the node is reset, its outputs at 0."""
    lines = []
    try:
        for line in conformance(talker):
            lines.append(line)
            told(line)
    finally:
        talker.reset()
    return lines
