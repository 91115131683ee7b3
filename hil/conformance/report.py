"""The report that a person can file: Markdown, and the same as JSON."""

from collections import Counter
from itertools import groupby
from typing import Any

from hil.conformance.talker import Talker
from hil.conformance.verdict import Line, Verdict


def as_json(talker: Talker, eds: str, lines: list[Line]) -> dict[str, Any]:
    """Everything, as plain data. ``ok``: no line failed; ``complete``: none was left out either."""
    counts = Counter(line.verdict for line in lines)
    return {
        "bus": talker.bus.name,
        "interface": talker.can.interface,
        "channel": talker.can.channel,
        "node_id": talker.node_id,
        "eds": eds,
        "allow_voltage": talker.allow_voltage,
        "ok": counts[Verdict.FAIL] == 0,
        "complete": counts[Verdict.NOT_TESTED] == 0,
        "passed": counts[Verdict.PASS],
        "failed": counts[Verdict.FAIL],
        "not_tested": counts[Verdict.NOT_TESTED],
        "frames_heard": len(talker.heard),
        "lines": [
            {
                "group": line.group,
                "name": line.name,
                "verdict": line.verdict.value,
                "expected": line.expected,
                "got": line.got,
            }
            for line in lines
        ],
    }


def conclusion(report: dict[str, Any]) -> str:
    """One sentence for the person who wants to enable it."""
    if not report["ok"]:
        return "Do not enable this amplifier: a line failed."
    if not report["complete"]:
        return "Nothing failed, but lines were not tested; enable it only if you know why each of them may be left out."
    return "All lines pass."


def as_markdown(report: dict[str, Any]) -> str:
    """The report as a document."""
    text = [
        "# Conformance of an amplifier",
        "",
        f"- bus {report['bus']}: {report['interface']} {report['channel']}, node {report['node_id']}",
        f"- EDS: {report['eds']}",
        f"- counts other than 0: {'allowed' if report['allow_voltage'] else 'not allowed (--allow-voltage)'}",
        f"- {report['passed']} passed, {report['failed']} failed, {report['not_tested']} not tested; "
        f"{report['frames_heard']} frames heard",
        "",
        f"**{conclusion(report)}**",
    ]
    for group, lines in groupby(report["lines"], key=lambda line: line["group"]):
        text += ["", f"## {group}", "", "| line | verdict | expected | what came |", "|---|---|---|---|"]
        text += [" | ".join(("|", *(_cell(line[key]) for key in _COLUMNS), "|")).strip() for line in lines]
    return "\n".join(text).replace("| |", "|") + "\n"


_COLUMNS = ("name", "verdict", "expected", "got")


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
