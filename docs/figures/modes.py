"""Writes the generated parts of safety.md: the mode diagram and the tables, each from the data that the code runs.

    python docs/figures/modes.py

Each part stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``; what is around them is written by hand.
"""

import re
from pathlib import Path

from pkxyz_ctrl.safety.gate import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import EVENT_MEANING, MODE_FACTS, TRANSITIONS, Event, Mode
from pkxyz_ctrl.safety.sdo_rules import WRITE_RULES
from pkxyz_ctrl.safety.trips import EXPLANATIONS

PAGE = Path(__file__).parents[1] / "understand" / "safety.md"

Rows = list[list[str]]


def _table(header: list[str], rows: Rows) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _yes(fact: bool) -> str:
    return "yes" if fact else ""


def diagram() -> str:
    """The transition table as a mermaid state diagram; arrows between the same two modes share one label."""
    labels: dict[tuple[Mode, Mode], list[str]] = {}
    for (source, event), target in TRANSITIONS.items():
        labels.setdefault((source, target), []).append(event.name)
    arrows = [
        f"    {source.name} --> {target.name}: {', '.join(events)}" for (source, target), events in labels.items()
    ]
    return "\n".join(["```mermaid", "stateDiagram-v2", f"    [*] --> {Mode.BOOT.name}", *arrows, "```"])


def modes() -> str:
    header = ["mode", "meaning", "voltage may go out", "loop closed", "node expected"]
    return _table(
        header,
        [
            [f"{mode.value} {mode.name}", facts.meaning]
            + [_yes(fact) for fact in (facts.may_energise, facts.loop_closed, facts.node_expected)]
            for mode, facts in MODE_FACTS.items()
        ],
    )


def transitions() -> str:
    rows = [
        [f"{event.name}", EVENT_MEANING[event]]
        + [TRANSITIONS[mode, event].name if (mode, event) in TRANSITIONS else "" for mode in Mode]
        for event in Event
    ]
    return _table(["event", "meaning", *(mode.name for mode in Mode)], rows)


def trips() -> str:
    return _table(
        ["trip", "what a person reads", "what to check"],
        [[str(trip.name), happened, remedy] for trip, (happened, remedy) in EXPLANATIONS.items()],
    )


def gate() -> str:
    rows = [[mode.name, *(_yes(kind in kinds) for kind in FrameKind)] for mode, kinds in PERMITTED.items()]
    return _table(["mode", *(str(kind.name) for kind in FrameKind)], rows)


def writes() -> str:
    rows = []
    for rule in WRITE_RULES:
        index = f"0x{rule.first:04X}" + (f" to 0x{rule.last:04X}" if rule.last > rule.first else "")
        subindex = f"{rule.sub_first}" + (f" to {rule.sub_last}" if rule.sub_last > rule.sub_first else "")
        rows.append([index, subindex, str(rule.size), rule.what, rule.permitted])
    return _table(["object", "sub-index", "bytes", "what", "permitted values"], rows)


PARTS = {
    "diagram": diagram,
    "modes": modes,
    "transitions": transitions,
    "trips": trips,
    "gate": gate,
    "writes": writes,
}


def filled_in(page: str) -> str:
    """``page`` with every generated part as it has to be now. Raises KeyError for a part that nobody generates."""
    pattern = r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)"
    return re.sub(pattern, lambda match: f"{match[1]}{PARTS[match[2]]()}\n{match[3]}", page, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(filled_in(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
