"""How exact the plant is, and what it costs."""

import numpy as np

from hil.bench.rigs.closed_loop import scan
from hil.bench.rigs.figure import Figure, repeated
from hil.bench.rigs.kernels import replay_plant
from hil.bench.rigs.reference_motion import reference_motion

PM = 1e-12
REPEATS = 11


def plant() -> list[Figure]:
    """The plant through 0.1 s of the default scan against scipy's DOP853, and its time for a period.

    The voltages are those that the controller chose in closed loop, replayed to both. A picometre is a thousandth of
    the noise, so nothing that a run shows is an artefact of the integration.
    """
    loop = scan()
    period_us = loop.setup.bus.period_us
    ours = loop.plant()
    ours.advance_to(ours.t_us + period_us)
    counts = np.vstack([loop.memory["row"]["drive_count"][0], loop.rows["drive_count"][:-1]])
    truth = reference_motion(ours.params, ours.state, counts, period_us)
    positions = np.empty_like(truth)
    for k, row in enumerate(counts):
        ours.drive(row)
        ours.advance_to(ours.t_us + period_us)
        positions[k] = ours.position_m
    if not np.array_equal(positions[:-1], loop.rows["position_m"][1:]):
        raise RuntimeError("the replayed plant is not where the recorded one was: not the same voltages")
    error_pm = np.linalg.norm(positions - truth, axis=1) / PM
    travel_um = np.ptp(truth, axis=0).max() * 1e6
    period, period_m = _period_us(counts)
    return [
        Figure("plant.error", float(error_pm[-1]), "pm", 1.0, "at most", None,
               f"after {len(counts)} periods and {travel_um:.1f} um; largest on the way {error_pm.max():.2g} pm"),
        Figure("plant.period", period, "us", None, None, period_m, "drive, move on by a period, sample; compiled loop"),
    ]  # fmt: skip


def _period_us(counts: np.ndarray) -> tuple[float, float]:
    loop = scan()
    plant = loop.plant()
    view = plant.state.view(np.uint8)
    before = view.copy()
    seen = np.zeros((len(counts), 3), np.int32)

    def run() -> None:
        view[:] = before
        replay_plant(plant.params, plant.state, counts, seen, loop.setup.bus.period_us)

    run()
    return repeated({"plant": run}, REPEATS)["plant"].per(len(counts))
