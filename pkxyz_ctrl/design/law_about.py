"""Whatever law the tick runs, as a linear law about a point of the workspace: what its margins are computed from."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.core.demand import LINEAR, OPEN_LOOP
from pkxyz_ctrl.design.lqg_equivalent import lqg_in_parts, set_point_gain
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, TappedLaw
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


def law_about(
    stage: Stage, law: NDArray[np.void], strokes_m: Array, perturbation: Perturbation = NOMINAL
) -> DiscreteLaw:
    """The linear law that ``law``, the (1,) array of ``design_law``, is about the position of ``strokes_m`` (3,), far
    from every limit and without quantisation.

    It is read from the numbers that the tick runs on, not designed again. Raises ``LawError`` for a law that only
    feeds forward: it closes no loop.
    """
    parts = law_in_parts(stage, law, strokes_m, perturbation)
    return parts.whole() if isinstance(parts, TappedLaw) else parts


def law_in_parts(
    stage: Stage, law: NDArray[np.void], strokes_m: Array, perturbation: Perturbation = NOMINAL
) -> DiscreteLaw | TappedLaw:
    """The same, a filter of taps apart: for whoever asks many loops, and can do without its states."""
    numbers = law["tick"][0]
    kind = int(numbers["kind"])
    if kind == OPEN_LOOP:
        raise LawError("this law only feeds forward: there is no loop, hence no margin; choose another controller")
    if kind == LINEAR:
        return _linear(stage, law, np.asarray(strokes_m, dtype=np.float64))
    return lqg_in_parts(stage, law, strokes_m, perturbation)


def _linear(stage: Stage, law: NDArray[np.void], strokes_m: Array) -> DiscreteLaw:
    """The matrices as they stand, times the feedback's authority at this point."""
    numbers = law["tick"][0]
    linear, feedback, n = numbers["linear"], numbers["feedback"], int(numbers["linear"]["order"])
    holding = stage.holding_forces(stage.forward_kinematics(strokes_m))
    share = float(np.clip(holding.min() / feedback["authority_force_n"], 0.0, 1.0))
    return DiscreteLaw(
        float(law["period_us"][0]) * 1e-6,
        linear["a"][:n, :n],
        linear["b"][:n],
        share * linear["c"][:, :n],
        share * linear["d"],
        set_point_gain=set_point_gain(numbers),
    )
