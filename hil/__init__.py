"""The harness: simulated bus, amplifier node, plant, lanes, studies, recordings, pictures and the command line.

The names below are the public interface, kept stable by semantic versioning; everything else is internal.

>>> import hil
>>> run = hil.run("raster")
>>> run.summary["rms_error_nm"]
>>> run["position_x_m"]
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.api.design import DesignedLaw as DesignedLaw
    from hil.api.design import design as design
    from hil.api.design import with_law as with_law
    from hil.api.identify import identify as identify
    from hil.api.montecarlo import SampledPlants as SampledPlants
    from hil.api.montecarlo import montecarlo as montecarlo
    from hil.api.run import Run as Run
    from hil.api.run import open_run as open_run
    from hil.api.run import run as run
    from hil.api.tune import tune as tune
    from hil.api.tune import tune_taps as tune_taps
    from hil.lanes.lane import Lane as Lane
    from hil.recording.journal import RecordingError as RecordingError
    from hil.runs.scenario import Scenario as Scenario
    from hil.runs.scenario import build_scenario as build_scenario
    from hil.runs.scenario import load_scenario as load_scenario
    from hil.studies.margins.excited import MeasurementError as MeasurementError
    from pkxyz_ctrl.config.files import CONFIG_DIR as CONFIG_DIR
    from pkxyz_ctrl.config.files import ConfigError as ConfigError
    from pkxyz_ctrl.design.identification.modal_fit import FitError as FitError
    from pkxyz_ctrl.design.model.design_error import DesignError as DesignError

_HOME = {
    "CONFIG_DIR": "pkxyz_ctrl.config.files",
    "ConfigError": "pkxyz_ctrl.config.files",
    "DesignError": "pkxyz_ctrl.design.model.design_error",
    "DesignedLaw": "hil.api.design",
    "FitError": "pkxyz_ctrl.design.identification.modal_fit",
    "Lane": "hil.lanes.lane",
    "MeasurementError": "hil.studies.margins.excited",
    "RecordingError": "hil.recording.journal",
    "Run": "hil.api.run",
    "SampledPlants": "hil.api.montecarlo",
    "Scenario": "hil.runs.scenario",
    "build_scenario": "hil.runs.scenario",
    "design": "hil.api.design",
    "identify": "hil.api.identify",
    "load_scenario": "hil.runs.scenario",
    "montecarlo": "hil.api.montecarlo",
    "open_run": "hil.api.run",
    "run": "hil.api.run",
    "tune": "hil.api.tune",
    "tune_taps": "hil.api.tune",
    "with_law": "hil.api.design",
}

__all__ = [
    "CONFIG_DIR",
    "ConfigError",
    "DesignError",
    "DesignedLaw",
    "FitError",
    "Lane",
    "MeasurementError",
    "RecordingError",
    "Run",
    "SampledPlants",
    "Scenario",
    "build_scenario",
    "design",
    "identify",
    "load_scenario",
    "montecarlo",
    "open_run",
    "run",
    "tune",
    "tune_taps",
    "with_law",
]


def __getattr__(name: str) -> Any:
    """Public names on first use: kernels and design tools take a second to load, and few programs need all of them."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
