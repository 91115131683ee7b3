"""Identify a stage in its running loop."""

from collections.abc import Callable

from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.studies.excited_lane import lane_on
from hil.studies.identify.identification import Identification
from hil.studies.identify.identification import identify as excite_and_fit
from hil.studies.margins.excited import Tones
from hil.studies.operating_point import operating_strokes
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.stage import Stage

Progress = Callable[[int, int], None]

AMPLITUDE_NM: dict[str, float] = {"multisine": 5.0, "stepped": 25.0}
"""Of each tone, by default: one alone may be larger than a hundred at once."""


def identify(
    *,
    stage: str = "reconstructed",
    plant: str | None = None,
    controller: str = "lqg",
    bus: str = "fd_5k",
    lane: Lane | str | None = None,
    tones: Tones = "multisine",
    amplitude_nm: float | None = None,
    periods: int = 6,
    at_um: tuple[float, float, float] | None = None,
    seed: int = 1,
    on_progress: Progress = lambda done, total: None,
    say: Callable[[str], object] = lambda words: None,
) -> Identification:
    """Excite the running loop on each axis and fit modes, gains and offsets, with standard errors.

    Configurations by name or file; ``plant``: where it is simulated, ``nominal`` by default. ``lane``: by default the
    machine's clock on a bus that leads to other processes or devices, which ``say`` is told about, and else the fast
    one. ``amplitude_nm``: of each tone, by default 5 (all at once) or 25 (one after another); ``periods``: measured on
    each axis, of 1 s or 0.1 s; ``at_um``: strokes, by default mid-workspace. Raises ``ConfigError`` for what can't be
    excited, ``MeasurementError`` where the loop opens, ``FitError`` where the response doesn't tell the modes.
    """
    on_bus, law = load("buses", bus, BusConfig), load("controllers", controller, ControllerConfig)
    closed_in = lane_on(on_bus, lane, plant)
    if law.law == "open_loop":
        raise ConfigError(
            f"controller {law.name!r} only feeds forward: what is added to the measurement never reaches its combs; "
            "choose another --controller"
        )
    strokes = operating_strokes(Stage.load(stage), at_um)
    return excite_and_fit(
        bare_setup(stage, plant or "nominal", law, on_bus, seed), strokes, closed_in, kind=tones,
        amplitude_m=1e-9 * (AMPLITUDE_NM[tones] if amplitude_nm is None else amplitude_nm), periods=periods,
        on_progress=on_progress, say=say,
    )  # fmt: skip
