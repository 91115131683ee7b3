"""What a run has learnt of its device, in a file that another run begins with: JSON that people can read."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.runs.versions import versions
from pkxyz_ctrl.config.adaptation import NUMBERS, Start
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, digest, parse, plain, read_bounded
from pkxyz_ctrl.config.refused import reason
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.device_errors import calibrated, spreads
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import DriveLimits, check_against

_FORMAT = "pkxyz adaptation 1"
_MAX_BYTES = 100_000
_ANEW = 'run with learn = "online" and without --adapted, which leaves adapted.json'


def save(
    path: Path, state: NDArray[np.void], stage: StageConfig, controller: ControllerConfig, origin: dict[str, Any]
) -> dict[str, Any] | None:
    """Write what ``state`` (1,) of ``ADAPTATION_STATE`` has learnt, and return it; None, and no file, for nothing.

    ``origin``: plain data that says where it comes from. Raises ``ConfigError``.
    """
    learnt = state[0]
    if controller.learn != "online" or learnt["updates"] == 0:
        return None
    spread = spreads(controller, Stage(stage))
    found, known = learnt["learnt"][: len(spread)], learnt["covariance"][:, : len(spread)]
    covariance = 0.5 * (known + known.T) * np.outer(spread, spread)
    values, errors = found * spread, np.sqrt(np.diag(covariance))
    data = {
        "format": _FORMAT,
        "provenance": origin | {"updates": int(learnt["updates"]), "versions": versions()},
        "stage_digest": digest(plain(stage)),
        "learnt": dict(zip(NUMBERS, values.tolist(), strict=True)),
        "standard_error": dict(zip(NUMBERS, errors.tolist(), strict=True)),
        "covariance": covariance.tolist(),
    }
    try:
        path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {reason(error)}") from None
    return {"learnt": data["learnt"], "standard_error": data["standard_error"]}


def begun_with(
    path: Path, stage: StageConfig, controller: ControllerConfig, bus: BusConfig, trajectory: Trajectory
) -> ControllerConfig:
    """The controller as it begins with what ``path`` holds. Raises ``ConfigError`` for no such file, one of another
    stage, one beyond the bounds, and where the device that it describes could not follow the trajectory.
    """
    if controller.learn != "online":
        raise ConfigError(f"{path}: controller {controller.name!r} does not learn, so it begins with nothing")
    start = _read(path, stage)
    numbers = plain(controller.adaptation) | {"start": plain(start)}
    begun = controller.model_copy(update={"adaptation": parse(numbers, type(controller.adaptation), str(path))})
    try:
        check_against(Stage(calibrated(stage, start.values)), trajectory, DriveLimits.of(controller, bus))
    except TrajectoryError as error:
        raise ConfigError(f"{path}: the device that it describes cannot follow: {error}") from None
    return begun


def _read(path: Path, stage: StageConfig) -> Start:
    try:
        data = json.loads(read_bounded(path, _MAX_BYTES).decode("utf-8"))
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as what a run has learnt: {error}; {_ANEW}") from None
    if not isinstance(data, dict) or data.get("format") != _FORMAT or not isinstance(data.get("learnt"), dict):
        raise ConfigError(f"{path}: is not what a run has learnt ({_FORMAT!r}); {_ANEW}")
    if data.get("stage_digest") != digest(plain(stage)):
        raise ConfigError(f"{path}: was learnt with another stage file than {stage.name!r}; {_ANEW}")
    values = {"values": [data["learnt"].get(name) for name in NUMBERS], "covariance": data.get("covariance")}
    return parse(values, Start, str(path))
