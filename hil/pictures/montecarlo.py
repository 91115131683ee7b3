"""A Monte Carlo study as a picture: what its figures are, and what makes them large."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hil.pictures.style import BLUE, VERMILION, dress, save, sheet, whole_numbers
from hil.studies.montecarlo import FIGURES, Result, Study


def draw_montecarlo(study: Study, results: Sequence[Result], path: Path) -> None:
    """Histograms of the figures, and the error over the stiffness and the quality factor that were sampled."""
    lost = sum(not r.ok for r in results)
    figure = sheet(12.5, 6.4, f"{study.scenario.controller.name} on {len(results)} plants; {lost} did not hold")
    panels = figure.subplots(2, 3)
    for axes, (name, unit) in zip(panels[0], FIGURES.items(), strict=True):
        values = [v for r in results if (v := getattr(r, name)) is not None]
        axes.hist(values, bins=min(40, max(5, len(values) // 5)), color=BLUE)
        words = "Ms" if name == "peak_s" else f"{name.replace('_', ' ').removesuffix(' nm')} ({unit})"
        dress(axes, words, "plants", grid="y")
        whole_numbers(axes.yaxis)
    held = [r for r in results if r.rms_error_nm is not None]
    sampled = [study.tolerances.sample(r.seed) for r in held]
    errors = [r.rms_error_nm for r in held]
    for axes, label, values in (
        (panels[1, 0], "stiffness (%)", [100 * c.perturbation.stiffness for c in sampled]),
        (panels[1, 1], "quality factor", [c.perturbation.quality_factor for c in sampled]),
        (panels[1, 2], "spread of the combs (%)", [100 * float(np.ptp(c.perturbation.comb_gain)) for c in sampled]),
    ):
        axes.plot(values, errors, ".", ms=4, color=VERMILION, alpha=0.7)
        dress(axes, label, "rms error (nm)")
    panels[1, 1].set_xscale("log")
    save(figure, path)
