"""The matrix as a picture: a row for each fault, a column for each law, the ticks until it was noticed."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Rectangle

from hil.studies.faults.matrix import Case
from hil.studies.faults.outcome import Outcome

_BAD, _UNSEEN = "#c0392b", "#dfe3e8"
_SHADES = ((5, "#1b7f4d"), (12, "#5aa469"), (50, "#a3c585"), (10_000, "#e4cf7b"))
_MEANING = "ticks from the fault to its decision; -: nothing to notice from inside, and safe"


def draw(outcomes: Sequence[Outcome], cases: Sequence[Case], path: Path) -> None:
    """Draw the outcomes of ``cases`` under every law that is among them, and write the picture."""
    laws = list(dict.fromkeys(outcome.law for outcome in outcomes))
    by_key = {(outcome.law, outcome.case): outcome for outcome in outcomes}
    figure, axes = plt.subplots(figsize=(4.6 + 0.85 * len(laws), 1.2 + 0.23 * len(cases)), layout="constrained")
    for row, case in enumerate(cases):
        for column, law in enumerate(laws):
            outcome = by_key[law, case.text]
            axes.add_patch(Rectangle((column, row), 0.96, 0.92, color=_colour(outcome)))
            text = "-" if outcome.ticks is None else str(outcome.ticks)
            dark = outcome.ticks is not None and (outcome.ticks <= 12 or not outcome.ok)
            axes.text(column + 0.48, row + 0.47, text, ha="center", va="center", fontsize=7,
                      color="white" if dark else "black")  # fmt: skip
    axes.set_xlim(0, len(laws))
    axes.set_ylim(len(cases), 0)
    axes.set_xticks([n + 0.48 for n in range(len(laws))], [Path(law).stem for law in laws], fontsize=8)
    axes.set_yticks([n + 0.47 for n in range(len(cases))], [case.text for case in cases], fontsize=7)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_xlabel(_MEANING + ("; red: a bound was not kept" if not all(o.ok for o in outcomes) else ""), fontsize=7)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _colour(outcome: Outcome) -> str:
    if not outcome.ok:
        return _BAD
    if outcome.ticks is None:
        return _UNSEEN
    return next(colour for limit, colour in _SHADES if outcome.ticks <= limit)
