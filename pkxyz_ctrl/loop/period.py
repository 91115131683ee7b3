"""Which function runs one period of a law: the compiled cycle, or the one that plans between its two parts."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.predictive_cycle import PredictiveCycle

Records = NDArray[np.void]
Array = NDArray[np.float64]
Period = Callable[..., Any]
"""Called as ``cycle.cycle`` is."""


def period_of(law: Records, reference: Records) -> Period:
    """``cycle.cycle`` for ``law``, a (1,) array of ``cycle.LAW``, and references of the type of ``reference``.

    A new one for each controller: that of the predictive law remembers its last plan.
    """
    if law["tick"]["kind"][0] == PREDICTIVE:
        return PredictiveCycle(law)
    return direct(cycling.cycle, law, cycling.new_memory(), reference)
