"""A search as pictures: how its trials went, and which numbers matter."""

from pathlib import Path

import numpy as np
import optuna
from matplotlib.axes import Axes

from hil.pictures.style import BLUE, FAINT, VERMILION, dress, legend, save, sheet, whole_numbers
from hil.studies.spread.trials import judged
from hil.studies.tune.search import Problem
from hil.studies.tune.tuning import finished

_WORDS = {
    "rms_error_nm": "rms error while scanning, mean of the plants (nm)",
    "bandwidth_hz": "|S| < -3 dB up to (Hz)",
}


def draw_tuning(study: optuna.Study, problem: Problem, importance: dict[str, float], folder: Path) -> None:
    """history.png, and importance.png if there are importances."""
    held = finished(study)
    figure = sheet(9, 4.2, f"{problem.search.name}: {len(judged(study))} trials, {len(held)} of them keep every goal")
    plot = figure.subplots()
    _draw_history(plot, study, held, problem.maximise)
    dress(plot, "trial", _WORDS[problem.search.objective])
    whole_numbers(plot.xaxis)
    save(figure, folder / "history.png")
    if not importance:
        return
    figure = sheet(8, 0.5 * len(importance) + 1.3, problem.search.name)
    plot = figure.subplots()
    names = list(importance)[::-1]
    plot.barh(names, [importance[name] for name in names], color=BLUE)
    dress(plot, "importance (PED-ANOVA), among the trials that keep every goal", grid="x")
    save(figure, folder / "importance.png")


def _draw_history(plot: Axes, study: optuna.Study, held: list[optuna.trial.FrozenTrial], maximise: bool) -> None:
    numbers, values = np.array([t.number for t in held]), np.array([t.value for t in held], dtype=np.float64)
    if len(values):
        plot.plot(numbers, values, ".", color=FAINT, label="tried")
        best_so_far = (np.maximum if maximise else np.minimum).accumulate(values)
        plot.step(numbers, best_so_far, where="post", color=BLUE, label="best so far")
        low, high = np.percentile(values, [0, 90] if not maximise else [10, 100])
        low, high = min(low, values[0]), max(high, values[0])  # where it began stays in sight
        plot.set_ylim(low - 0.1 * (high - low) - 1e-9, high + 0.1 * (high - low) + 1e-9)
    missed = [t.number for t in study.get_trials(deepcopy=False) if t.state == optuna.trial.TrialState.PRUNED]
    if missed:
        floor = np.full(len(missed), plot.get_ylim()[0])
        plot.plot(missed, floor, "|", color=VERMILION, ms=5, label="misses a margin")
    legend(plot)
