"""The matrix as a picture: a row for each fault, a column for each law, the ticks until it was noticed."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.patches import Rectangle

from hil.pictures.style import BAD, GOOD, SMALL_PT, TINY_PT, WASH, dress, save, sheet
from hil.studies.faults.matrix import Case
from hil.studies.faults.outcome import Outcome

_SHADES = ((5, GOOD), (12, "#5aa469"), (50, "#a3c585"), (10_000, "#e4cf7b"))
_MEANING = "ticks from the fault to its decision; -: nothing to notice from inside, and safe"


def draw(outcomes: Sequence[Outcome], cases: Sequence[Case], path: Path) -> None:
    """Draw the outcomes of ``cases`` under every law that is among them, and write the picture."""
    laws = list(dict.fromkeys(outcome.law for outcome in outcomes))
    by_key = {(outcome.law, outcome.case): outcome for outcome in outcomes}
    figure = sheet(4.6 + 0.85 * len(laws), 1.2 + 0.23 * len(cases))
    axes = figure.subplots()
    dress(axes, grid="")
    for row, case in enumerate(cases):
        for column, law in enumerate(laws):
            outcome = by_key[law, case.text]
            axes.add_patch(Rectangle((column, row), 0.96, 0.92, color=_colour(outcome)))
            text = "-" if outcome.ticks is None else str(outcome.ticks)
            dark = outcome.ticks is not None and (outcome.ticks <= 12 or not outcome.ok)
            axes.text(column + 0.48, row + 0.47, text, ha="center", va="center", fontsize=TINY_PT,
                      color="white" if dark else "black")  # fmt: skip
    axes.set_xlim(0, len(laws))
    axes.set_ylim(len(cases), 0)
    axes.set_xticks([n + 0.48 for n in range(len(laws))], [Path(law).stem for law in laws], fontsize=SMALL_PT)
    axes.set_yticks([n + 0.47 for n in range(len(cases))], [case.text for case in cases], fontsize=TINY_PT)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_xlabel(
        _MEANING + ("; red: a bound was not kept" if not all(o.ok for o in outcomes) else ""), fontsize=TINY_PT
    )
    save(figure, path)


def _colour(outcome: Outcome) -> str:
    if not outcome.ok:
        return BAD
    if outcome.ticks is None:
        return WASH
    return next(colour for limit, colour in _SHADES if outcome.ticks <= limit)
