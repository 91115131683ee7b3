"""Identify a stage in its running loop."""

from collections.abc import Callable
from typing import Literal

from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.studies.identify.identification import Identification
from hil.studies.identify.identification import identify as excite_and_fit
from hil.studies.operating_point import operating_strokes
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.stage import Stage

Progress = Callable[[int, int], None]
Kind = Literal["multisine", "stepped"]

AMPLITUDE_NM: dict[str, float] = {"multisine": 5.0, "stepped": 25.0}
"""Of each tone, by default: one alone may be larger than a hundred at once."""


def identify(
    *,
    stage: str = "reconstructed",
    plant: str = "nominal",
    controller: str = "lqg",
    bus: str = "fd_5k",
    lane: Lane | str = Lane.FAST,
    tones: Kind = "multisine",
    amplitude_nm: float | None = None,
    periods: int = 6,
    at_um: tuple[float, float, float] | None = None,
    seed: int = 1,
    on_progress: Progress = lambda done, total: None,
) -> Identification:
    """Excite the running loop on each axis and fit modes, gains and offsets, with standard errors.

    Configurations by name or file. ``amplitude_nm``: of each tone, by default 5 (all at once) or 25 (one after
    another); ``periods``: measured on each axis, of 1 s or 0.1 s; ``at_um``: strokes, by default mid-workspace. Raises
    ``ConfigError`` for what can't be excited, ``MeasurementError`` where the loop opens, ``FitError`` where the
    response doesn't tell the modes.
    """
    on_bus, law = load("buses", bus, BusConfig), load("controllers", controller, ControllerConfig)
    if lane == Lane.LOCKSTEP and on_bus.can is None:
        raise ConfigError(f"bus {on_bus.name!r} has no [can] and carries no frames; use --lane fast")
    if law.law == "open_loop":
        raise ConfigError(
            f"controller {law.name!r} only feeds forward: what is added to the measurement never reaches its combs; "
            "choose another --controller"
        )
    strokes = operating_strokes(Stage.load(stage), at_um)
    return excite_and_fit(
        bare_setup(stage, plant, law, on_bus, seed), strokes, Lane(lane), kind=tones,
        amplitude_m=1e-9 * (AMPLITUDE_NM[tones] if amplitude_nm is None else amplitude_nm), periods=periods,
        on_progress=on_progress,
    )  # fmt: skip
