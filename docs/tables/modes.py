"""Writes the generated parts of safety.md: the mode diagram and the tables, each from the data that the code runs.

    python docs/tables/modes.py

Each part stands between ``<!-- generated: NAME -->`` and ``<!-- end -->``; what is around them is written by hand.
"""

import re
from pathlib import Path

from pkxyz_ctrl.safety.gate import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import MODE_FACTS, TRANSITIONS, Mode

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


def gate() -> str:
    rows = [[mode.name, *(_yes(kind in kinds) for kind in FrameKind)] for mode, kinds in PERMITTED.items()]
    return _table(["mode", *(str(kind.name) for kind in FrameKind)], rows)


PARTS = {"diagram": diagram, "modes": modes, "gate": gate}


def filled_in(page: str) -> str:
    """``page`` with every generated part as it has to be now. Raises KeyError for a part that nobody generates."""
    pattern = r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)"
    return re.sub(pattern, lambda match: f"{match[1]}{PARTS[match[2]]()}\n{match[3]}", page, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(filled_in(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
