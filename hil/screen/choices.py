"""What several commands take: where a loop runs, with what it is excited, and about which point."""

from enum import StrEnum
from typing import TYPE_CHECKING

from pkxyz_ctrl.config.files import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pkxyz_ctrl.stage import Stage


class Tones(StrEnum):
    """What is added to the measurement: all tones at once, or one after another."""

    MULTISINE = "multisine"
    STEPPED = "stepped"


def operating_strokes(stage: "Stage", at_um: tuple[float, float, float] | None) -> "NDArray[np.float64]":
    """Strokes (3,) in m of ``--at``, by default mid-workspace. Raises ``ConfigError`` for a point at which the combs
    can't hold the stage: there no loop is closed.
    """
    import numpy as np

    from pkxyz_ctrl.stage import StageDomainError

    limits = stage.config.limits
    if at_um is None:
        return np.full(3, 0.5 * (limits.stroke_min_m + limits.stroke_max_m))
    strokes = np.array(at_um) * 1e-6
    words = " ".join(f"{q:g}" for q in at_um)
    if not ((strokes >= limits.stroke_min_m) & (strokes <= limits.stroke_max_m)).all():
        raise ConfigError(
            f"--at {words}: strokes go from {limits.stroke_min_m * 1e6:g} to {limits.stroke_max_m * 1e6:g} um"
        )
    try:
        volts = stage.holding_voltages(stage.forward_kinematics(strokes))
    except StageDomainError as error:
        raise ConfigError(f"--at {words}: {error}; give a point that the combs can hold") from None
    if not volts.min() > 0.0:
        raise ConfigError(f"--at {words}: a comb at 0 V closes no loop; give a point with every comb pulling")
    return strokes
