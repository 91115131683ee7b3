"""Faults as pictures: the matrix, with a row for each fault and a column for each law, and a soak."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Patch, Rectangle

from hil.pictures.style import BAD, BLUE, FAINT, GOOD, SMALL_PT, TINY_PT, WASH, dress, legend, save, sheet
from hil.studies.faults.matrix import Case
from hil.studies.faults.outcome import Outcome
from hil.studies.soaks import decisions_in_words

if TYPE_CHECKING:
    from hil.studies.soak import Soaked

_SHADES = ((5, GOOD), (12, "#5aa469"), (50, "#a3c585"), (10_000, "#e4cf7b"))
_MEANING = "number: ticks from the fault to the decision to go to 0 V"


def draw(outcomes: Sequence[Outcome], cases: Sequence[Case], path: Path) -> None:
    """Draw the outcomes of ``cases`` under every law that is among them, and write the picture."""
    laws = list(dict.fromkeys(outcome.law for outcome in outcomes))
    by_key = {(outcome.law, outcome.case): outcome for outcome in outcomes}
    figure = sheet(4.6 + 0.85 * len(laws), 1.9 + 0.23 * len(cases), "How soon each fault is noticed, under each law")
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
    axes.set_xlabel(_MEANING, fontsize=SMALL_PT)
    figure.legend(
        handles=_key(outcomes),
        loc="outside lower center",
        ncols=max(1, len(laws) // 2),
        frameon=False,
        fontsize=SMALL_PT,
    )
    save(figure, path)


def _key(outcomes: Sequence[Outcome]) -> list[Patch]:
    """What the shades mean, those that occur."""
    lows = (0, *(limit + 1 for limit, _ in _SHADES))
    words = [f"{low} to {limit} ticks" for low, (limit, _) in zip(lows, _SHADES, strict=False)]
    words[-1] = f"more than {lows[-2] - 1} ticks"
    shades = [(colour, text) for (_, colour), text in zip(_SHADES, words, strict=True)]
    shades += [(WASH, "nothing to notice from inside, and safe"), (BAD, "a bound was not kept")]
    seen = {_colour(outcome) for outcome in outcomes}
    return [Patch(color=colour, label=text) for colour, text in shades if colour in seen]


def _colour(outcome: Outcome) -> str:
    if not outcome.ok:
        return BAD
    if outcome.ticks is None:
        return WASH
    return next(colour for limit, colour in _SHADES if outcome.ticks <= limit)


def draw_soak(soaked: "Soaked", path: Path) -> None:
    """A soak: memory, and what was decided, minute by minute."""
    parts = np.arange(1, len(soaked.memory_mb) + 1)
    caption = decisions_in_words(soaked.faults, soaked.undecided, soaked.decisions, soaked.misled)
    figure = sheet(7.6, 4.4, caption)
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
