"""The point about which a law is looked at: strokes that the combs can hold."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.stage import Stage, StageDomainError


def operating_strokes(stage: Stage, at_um: tuple[float, float, float] | None) -> NDArray[np.float64]:
    """Strokes (3,) in m from those in um, by default mid-workspace. Raises ``ConfigError`` for a point at which the
    combs can't hold the stage: there no loop is closed.
    """
    limits = stage.config.limits
    if at_um is None:
        return np.full(3, 0.5 * (limits.stroke_min_m + limits.stroke_max_m))
    strokes = np.array(at_um) * 1e-6
    words = " ".join(f"{q:g}" for q in at_um)
    if not ((strokes >= limits.stroke_min_m) & (strokes <= limits.stroke_max_m)).all():
        raise ConfigError(
            f"at {words} um: strokes go from {limits.stroke_min_m * 1e6:g} to {limits.stroke_max_m * 1e6:g} um"
        )
    try:
        volts = stage.holding_voltages(stage.forward_kinematics(strokes))
    except StageDomainError as error:
        raise ConfigError(f"at {words} um: {error}; give a point that the combs can hold") from None
    if not volts.min() > 0.0:
        raise ConfigError(f"at {words} um: a comb at 0 V closes no loop; give a point with every comb pulling")
    return strokes
