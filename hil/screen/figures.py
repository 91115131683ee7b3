"""The figures that every command tells alike."""

import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil.runs.metrics import RowFigures
    from hil.runs.summary import LoopFigures


def error_lines(rows: "RowFigures", errors_are_of: str) -> Iterator[str]:
    """A line for each figure of three axes that every run has: error while scanning, and in holds about the set-point
    and about the mean; and what of the device has changed."""
    by = ", by the estimate" if errors_are_of == "estimate" else ""
    for measured, words in (
        (rows.rms_error_nm, "rms error while scanning"),
        (rows.hold_rms_nm, "rms error in holds"),
        (rows.hold_noise_nm, "noise in holds"),
    ):
        if measured:
            yield f"{words}{by}, x / y / z: {' / '.join(f'{value:.2f}' for value in measured.values())} nm"
    yield from (f"warning: {words}" for words in rows.warnings)


def lacking_lines(protections: Iterable[str]) -> Iterator[str]:
    """A line for each protection that the amplifier of a run does not give."""
    yield from (f"the amplifier lacks a protection: {words}" for words in protections)


def loss_lines(loop: "LoopFigures") -> Iterator[str]:
    """A line for each kind of frame or row that did not get through at rate, with how many."""
    from hil.runs.metrics import METRICS

    for name in ("refused_frames", "dropped_frames", "blocked_frames", "lost_rows"):
        if count := getattr(loop, name):
            yield f"lost: {count} {METRICS[name].removesuffix(', at rate')}"


def where_to_read(faults: Iterable[str]) -> str | None:
    """A command that leads from the codes in these texts, of faults in brackets and of emergencies, to their causes and
    remedies.
    """
    found = re.findall(r"\(([A-Z]+(?:_[A-Z0-9]+)*)\)|EMCY (0x[0-9A-F]{4})", " ".join(faults))
    codes = dict.fromkeys(fault or emergency for fault, emergency in found)
    return f"usual causes, and what clears them: `pkxyz explain {' '.join(codes)}`" if codes else None
