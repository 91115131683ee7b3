"""What learning from period to period reaches: 10 um frames at 50 lines/s, on the harsh and the nominal plant."""

import numpy as np

from hil.bench.rigs.figure import Figure
from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.period_errors import WITHIN, PeriodErrors
from hil.runs.scenario import load_scenario

LINE_M = 10e-6
_SETTLED = 3
"""Periods from which on lines are looked at: all of them together, as one has noise of its own."""


def learning() -> list[Figure]:
    """Over the compiled loop, whose bits are those of the bus."""
    harsh, _, _ = _run("frames_harsh")
    errors, floor_nm, faults = _run("frames")
    found = harsh.figures()
    assert found.learning_factor is not None, "more than one period was scanned"
    assert found.learning_factor_true is not None
    by_period = ", ".join(f"{value:.1f}" for value in harsh.sensed_nm)
    after = np.sqrt(np.mean([line**2 for line in errors.line_error_nm[_SETTLED:]], axis=0))
    before = errors.line_error_nm[0]
    words = f"harsh plant, periodic error of the first period over that after {WITHIN} more"
    of = "nominal plant, RMS error of the true position on the lines, worst axis"
    return [
        Figure("learning.factor", found.learning_factor, "times", 10.0, "at least", None,
               f"{words}, as sensed (by period: {by_period} nm)"),
        Figure("learning.factor_true", found.learning_factor_true, "times", 10.0, "at least", None,
               f"{words}, of the true position"),
        Figure("learning.raster_before", float(before.max() * 1e-9 / LINE_M * 100), "% of line", 0.1, "at most", None,
               f"{of}, first period, before anything is learnt"),
        Figure("learning.raster", float((after / floor_nm).max()), "x floor", 1.2, "at most", None,
               f"{of}, from period {_SETTLED} on, over its deviation in a hold ({_three(after)} over "
               f"{_three(floor_nm)} nm)"),
        Figure("learning.faults", float(faults), "count", 0.0, "at most", None, "fault decisions"),
    ]  # fmt: skip


def _run(scenario: str) -> tuple[PeriodErrors, np.ndarray, int]:
    """Errors by period, deviation (3,) in the hold in nm, and faults."""
    loaded = load_scenario(scenario)
    assert loaded.config.learning is not None
    errors = PeriodErrors(loaded.trajectory, loaded.bus.period_us, loaded.config.learning)
    metrics = Metrics(loaded.trajectory, loaded.bus.period_us)

    def on_block(block: np.ndarray) -> None:
        errors.update(block)
        metrics.update(block)

    result = lanes.run(loaded.setup(), Lane.FAST, on_block=on_block)
    floor = metrics.figures().hold_noise_nm
    assert floor is not None, "the scenario ends in a hold"
    return errors, np.array(list(floor.values())), len(result.faults)


def _three(values: np.ndarray) -> str:
    return " / ".join(f"{value:.2f}" for value in values)
