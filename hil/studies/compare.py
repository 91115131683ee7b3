"""Several laws on one scenario and one plant: what each reaches, side by side."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.run import require_bus
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import ConfigError

Rows = NDArray[np.void]

DEFAULT = ("youla", "lqg", "lqg_wide", "robust", "hinf", "pi_notch", "irc", "mpc", "open_loop")
"""What is compared if nobody says what."""


@dataclass(frozen=True)
class Compared:
    """One law's run."""

    controller: str
    law: str
    figures: dict[str, Any]
    """by name of ``METRICS``; none where it could not be run"""
    gave_up: int
    """ticks in which a solver's answer was not used"""
    problem: str | None
    """why it could not be run, or the first fault"""
    t_s: NDArray[np.float64]
    """(n,) of the trajectory, while tracking"""
    error_nm: NDArray[np.float64]
    """(n, 3), true position less reference"""

    def as_json(self) -> dict[str, Any]:
        """Plain data, without the traces."""
        return {
            "controller": self.controller, "law": self.law, "gave_up": self.gave_up, "problem": self.problem,
            **self.figures,
        }  # fmt: skip


def compare(
    scenario: str,
    controllers: tuple[str, ...] = DEFAULT,
    *,
    stage: str | None = None,
    plant: str | None = None,
    seed: int | None = None,
    lane: Lane = Lane.FAST,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Compared]:
    """Run a scenario with each controller. A law that can't be run there says why, and the others go on.

    Raises ``ConfigError`` for a scenario, a stage, a plant or a controller's file that can't be used.
    """
    found = []
    for n, name in enumerate(controllers):
        found.append(_run(scenario, name, stage, plant, seed, lane))
        on_progress(n + 1, len(controllers))
    return found


def _run(
    scenario: str, controller: str, stage: str | None, plant: str | None, seed: int | None, lane: Lane
) -> Compared:
    loaded = load_scenario(scenario, controller=controller, stage=stage, plant=plant, seed=seed)
    require_bus(loaded, lane)
    metrics = Metrics(loaded.trajectory, loaded.bus.period_us)
    times: list[NDArray[np.float64]] = []
    errors: list[NDArray[np.float64]] = []
    gave_up = 0

    def on_block(block: Rows) -> None:
        nonlocal gave_up
        metrics.update(block)
        gave_up += int(np.count_nonzero(block["solver_iterations"] < 0))
        tracking = block[block["reference_tick"] >= 0]
        times.append(tracking["reference_tick"] * (loaded.bus.period_us * 1e-6))
        errors.append((tracking["position_m"] - tracking["reference_m"]) * 1e9)

    try:
        setup = loaded.setup()
        law = setup.law  # designed here, so that a refusal is of the law and not of the files
        assert len(law) == 1
    except ConfigError as error:
        return Compared(controller, loaded.controller.law, {}, 0, str(error), np.empty(0), np.empty((0, 3)))
    result = lanes.run(setup, lane, on_block=on_block)
    figures = dataclasses.asdict(metrics.figures()) | {
        "faults": len(result.faults),
        "missed_ticks": result.missed_ticks,
    }
    problem = result.faults[0] if result.faults else None
    return Compared(
        controller, loaded.controller.law, figures, gave_up, problem, np.concatenate(times), np.concatenate(errors)
    )
