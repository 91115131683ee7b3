"""A law, a bus and a stage that bear a machine that stands still: for tests whose processes run at rate, and not about
that.
"""

import re
from pathlib import Path

from pkxyz_ctrl.config.files import find

PUNCTUALITY = (
    "stale", "sequence", "innovation", "residual", "unexplained_force", "saturation", "overrun", "slew",
)  # fmt: skip
"""Monitors that a controller which is late, or a plant which is, sets off."""
_TIME_OUTS = "node_heartbeat_timeout_ms = 900\nboot_timeout_us = 20_000_000\n"
_TIME_OUTS += "start_timeout_us = 5_000_000\nsdo_timeout_us = 5_000_000\n"
_OF_THE_NODE = "controller_heartbeat_timeout_ms = 900\ndrive_timeout_ms = 900\n"


def replaced(pattern: str, by: str, text: str) -> str:
    """With the one line in which the pattern stands changed."""
    text, found = re.subn(pattern, by, text, flags=re.MULTILINE)
    assert found == 1, pattern
    return text


def patient_law(folder: Path, name: str = "lqg") -> Path:
    """A shipped law's file that forgives missed ticks, ``patient.toml`` in the folder."""
    law = find("controllers", name).read_text(encoding="utf-8")
    law = re.sub(rf"^({'|'.join(PUNCTUALITY)})_count = .*\n", "", law, flags=re.MULTILINE)
    off = "".join(f"{monitor}_count = -1\n" for monitor in PUNCTUALITY)
    law = replaced(r"^(frozen_count = )", rf"{off}\1", law)
    path = folder / "patient.toml"
    path.write_text(law, encoding="utf-8")
    return path


def patient_bus(path: Path, name: str = "unix_1k", *, is_node_patient: bool = True) -> Path:
    """A shipped bus between processes, in a folder ``bus`` beside the file ``path`` that becomes it.

    A silence of 0.9 s is none; the node may keep its own idea of that.
    """
    bus = find("buses", name).read_text(encoding="utf-8")
    bus = replaced(r'^channel = "pkxyz"', f'channel = "{path.parent}/bus"', bus) + _TIME_OUTS
    path.write_text(bus + (_OF_THE_NODE if is_node_patient else ""), encoding="utf-8")
    return path


def slow_bus(path: Path) -> Path:
    """A patient bus at 250 Hz, where even a busy machine misses few ticks."""
    text = patient_bus(path).read_text(encoding="utf-8")
    for key, value in (("period", 4000), ("sense_deadline", 3200), ("heartbeat_deadline", 3960)):
        text = replaced(rf"^{key}_us = \d+", f"{key}_us = {value}", text)
    path.write_text(text, encoding="utf-8")
    return path


def slow_stage(path: Path) -> Path:
    """The default stage with a hundred times its mass, which is ten times slower: to 250 Hz what that is to 2.5 kHz."""
    text = find("stages", "reconstructed").read_text(encoding="utf-8")
    path.write_text(replaced(r"^mass_kg = 4\.833e-6", "mass_kg = 4.833e-4", text), encoding="utf-8")
    return path
