"""The tables of modes and gate, and the diagram of the modes, from the data that the code runs."""

from pkxyz_ctrl.safety.gate_rules import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import MODE_FACTS, TRANSITIONS, Mode

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
    """Every mode, and what holds in it."""
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
    """Which frames the transmit gate lets out in which mode."""
    rows = [[mode.name, *(_yes(kind in kinds) for kind in FrameKind)] for mode, kinds in PERMITTED.items()]
    return _table(["mode", *(str(kind.name) for kind in FrameKind)], rows)
