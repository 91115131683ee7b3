"""A soak as a picture: memory, and what was decided, minute by minute."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.pictures.style import BAD, BLUE, FAINT, dress, legend, save, sheet

if TYPE_CHECKING:
    from hil.studies.soak import Soaked


def draw_soak(soaked: "Soaked", path: Path) -> None:
    """Draw what came of ``soaked`` and write the picture."""
    parts = np.arange(1, len(soaked.memory_mb) + 1)
    figure = sheet(7.2, 4.2)
    memory, decided = figure.subplots(2, 1, sharex=True)
    memory.plot(parts, soaked.memory_mb, color=BLUE, marker=".")
    memory.set_ylim(0, 1.15 * max(soaked.memory_mb, default=1.0))
    dress(memory, y_label="resident memory (MB)")
    decided.step(parts, soaked.faults_each, where="mid", color=FAINT, label="faults that began")
    decided.step(parts, soaked.decisions_each, where="mid", color=BAD, label="decisions")
    decided.step(parts, soaked.returns_each, where="mid", color=BLUE, label="back to tracking")
    decided.set_ylim(bottom=0)
    dress(decided, f"recording, {soaked.minutes_each:g} min of stage time each", "in each recording")
    legend(decided, "lower left", columns=3)
    save(figure, path)
