"""A soak as a picture: memory, and what was decided, minute by minute."""

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

if TYPE_CHECKING:
    from hil.studies.soak import Soaked

_BLUE, _RED, _GREY = "#1f5f8b", "#c0392b", "#8a929b"


def draw_soak(soaked: "Soaked", path: Path) -> None:
    """Draw what came of ``soaked`` and write the picture."""
    parts = np.arange(1, len(soaked.memory_mb) + 1)
    figure, (memory, decided) = plt.subplots(2, 1, figsize=(7.2, 4.2), sharex=True, layout="constrained")
    memory.plot(parts, soaked.memory_mb, color=_BLUE, marker=".")
    memory.set_ylim(0, 1.15 * max(soaked.memory_mb, default=1.0))
    memory.set_ylabel("resident memory (MB)")
    decided.step(parts, soaked.faults_each, where="mid", color=_GREY, label="faults that began")
    decided.step(parts, soaked.decisions_each, where="mid", color=_RED, label="decisions")
    decided.step(parts, soaked.returns_each, where="mid", color=_BLUE, label="back to tracking")
    decided.set_ylim(bottom=0)
    decided.set_ylabel("in each recording")
    decided.set_xlabel(f"recording, {soaked.minutes_each:g} min of stage time each")
    decided.legend(frameon=False, fontsize=8, ncols=3, loc="lower left")
    for axes in (memory, decided):
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
    plt.close(figure)
