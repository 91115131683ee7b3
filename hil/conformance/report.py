"""The report that a person can file: Markdown, and the same as JSON."""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from itertools import groupby
from typing import Any

from hil.conformance.talker import Talker
from hil.conformance.verdict import CheckResult, Verdict

IDENTITY = ("vendor_id", "product_code", "revision", "serial")
"""Of 0x1018, sub-indices 1 to 4."""


def as_json(
    talker: Talker, eds: str, lines: list[CheckResult], identity: Sequence[int | None], made: datetime
) -> dict[str, Any]:
    """Everything, as plain data. ``ok``: nothing unsafe was seen, and nothing is left that only a voltmeter can tell;
    ``complete``: no line was left out; ``digest``: of all the rest.
    """
    counts = Counter(line.verdict for line in lines)
    report = {
        "made": made.isoformat(timespec="seconds"),
        "module": dict(zip(IDENTITY, identity, strict=True)),
        "bus": talker.bus.name,
        "interface": talker.can.interface,
        "channel": talker.can.channel,
        "node_id": talker.node_id,
        "eds": eds,
        "allow_voltage": talker.allow_voltage,
        "ok": counts[Verdict.UNSAFE] + counts[Verdict.MEASURE] == 0,
        "complete": counts[Verdict.NOT_TESTED] == 0,
        "passed": counts[Verdict.PASS],
        "unsafe": counts[Verdict.UNSAFE],
        "against_cia": counts[Verdict.AGAINST_CIA],
        "other_contract": counts[Verdict.OTHER_CONTRACT],
        "to_measure": counts[Verdict.MEASURE],
        "not_tested": counts[Verdict.NOT_TESTED],
        "frames_heard": len(talker.heard),
        "lines": [
            {
                "group": line.group,
                "name": line.name,
                "verdict": line.verdict.value,
                "expected": line.expected,
                "basis": line.basis,
                "got": line.got,
            }
            for line in lines
        ],
    }
    return report | {"digest": digest_of(report)}


def digest_of(report: dict[str, Any]) -> str:
    """``sha256:...`` of everything else in a report. Against accidents: whoever changes it can make it anew."""
    rest = {key: value for key, value in report.items() if key != "digest"}
    return f"sha256:{hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()}"


def conclusion(report: dict[str, Any]) -> str:
    """One sentence for the person who wants to enable it."""
    if report["unsafe"]:
        return "Do not enable this amplifier: it is unsafe here."
    if report["to_measure"]:
        return "Do not enable this amplifier before a voltmeter has said what its own words do not."
    others = report["against_cia"] + report["other_contract"]
    told = []
    if others:
        told.append(
            "Nothing unsafe was seen, but it is not the amplifier of our contract: `pkxyz run` may refuse it, and each "
            "protection that deviates is missing."
        )
    if not report["complete"]:
        told.append("Lines were not tested: enable it only if you know why each of them may be left out.")
    return " ".join(told) or "All lines pass."


def counted(report: dict[str, Any]) -> str:
    """How many lines came out how."""
    return (
        f"{report['passed']} passed, {report['unsafe']} unsafe, {report['to_measure']} to measure, "
        f"{report['against_cia']} against CiA, {report['other_contract']} other than our contract, "
        f"{report['not_tested']} not tested"
    )


def as_markdown(report: dict[str, Any]) -> str:
    """The report as a document."""
    text = [
        "# Conformance of an amplifier",
        "",
        f"- {report['made']}, {', '.join(f'{name} {_number(value)}' for name, value in report['module'].items())}",
        f"- bus {report['bus']}: {report['interface']} {report['channel']}, node {report['node_id']}",
        f"- EDS: {report['eds']}",
        f"- counts other than 0: {'allowed' if report['allow_voltage'] else 'not allowed (--allow-voltage)'}",
        f"- {counted(report)}; {report['frames_heard']} frames heard",
        "",
        f"**{conclusion(report)}**",
    ]
    for group, lines in groupby(report["lines"], key=lambda line: line["group"]):
        text += ["", f"## {group}", "", "| line | verdict | expected | by | what came |", "|---|---|---|---|---|"]
        text += [" | ".join(("|", *(_cell(line[key]) for key in _COLUMNS), "|")).strip() for line in lines]
    return "\n".join(text).replace("| |", "|") + "\n"


_COLUMNS = ("name", "verdict", "expected", "basis", "got")


def _number(value: int | None) -> str:
    return "unknown" if value is None else f"0x{value:X}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
