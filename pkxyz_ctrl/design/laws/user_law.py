"""A law of the user's own: any python-control StateSpace or TransferFunction, checked before it may touch the stage."""

import math

import control
import numpy as np
import scipy.linalg

from pkxyz_ctrl.design.margins.margins import Margins, margins
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, discretise, siso, stack
from pkxyz_ctrl.design.model.loop_plant import LoopPlant


class UnstableLawError(LawError):
    """The loop of the law and the sampled, delayed stage would not be stable, or only just; the message says which."""


def user_law(
    system: control.lti.LTI,
    plant: LoopPlant,
    *,
    method: str = "tustin",
    delay_margin_s: float | None = None,
) -> tuple[DiscreteLaw, Margins]:
    """The law w = -K (y - r) for a system K in N/m, and its margins on the plant.

    ``system`` has 3 inputs and outputs (platform x, y, z), or one of each, which then serves every axis alike. A
    continuous one is sampled by ``method`` ("tustin" or "zoh"); a discrete one must have the plant's period (dt=True
    counts as that). The loop must be stable with ``delay_margin_s`` more delay than is known, by default a quarter of
    a period. Raises ``LawError``, and ``UnstableLawError`` where the loop would not be stable.
    """
    law = discrete_law(system, plant.period_s, method)
    return law, require_robust(law, plant, delay_margin_s)


def require_robust(law: DiscreteLaw, plant: LoopPlant, delay_margin_s: float | None = None) -> Margins:
    """The margins of a law that is stable on the plant, and with ``delay_margin_s`` (a quarter of a period) more delay.

    Raises ``UnstableLawError`` for another.
    """
    found = margins(plant, law)
    if not found.stable:
        raise UnstableLawError(
            f"refused: with the stage, its sampling and its delay the loop is unstable "
            f"(spectral radius {found.spectral_radius:.4f}){_likely_reason(law, plant)}"
        )
    needed = 0.25 * plant.period_s if delay_margin_s is None else delay_margin_s
    for name, axis in zip("xyz", found.axes, strict=True):
        if axis.delay_margin_s < needed:
            raise UnstableLawError(
                f"refused: axis {name} bears {axis.delay_margin_s * 1e6:.1f} us of additional delay, and "
                f"{needed * 1e6:.1f} us are asked for; lower the gain or the bandwidth"
            )
    return found


def discrete_law(system: control.lti.LTI, period_s: float, method: str = "tustin") -> DiscreteLaw:
    """The system as a law with a period, unchecked against any plant. Raises ``LawError``."""
    if not isinstance(system, (control.StateSpace, control.TransferFunction)):
        raise LawError(f"a law is a StateSpace or a TransferFunction of python-control, not {type(system).__name__}")
    size = (system.noutputs, system.ninputs)
    if size not in ((1, 1), (3, 3)):
        raise LawError(
            f"a law has 3 inputs and 3 outputs, or one of each for every axis; this one has {size[1]} and {size[0]}"
        )
    if size == (1, 1):
        axis = _sampled(siso(system), period_s, method)
        return stack(period_s, [axis, axis, axis])
    sampled = _sampled(state_space(system), period_s, method)
    return DiscreteLaw(period_s, sampled.A, sampled.B, sampled.C, sampled.D)


def state_space(system: control.lti.LTI) -> control.StateSpace:
    """A 3 x 3 system as state space, entry by entry, as python-control converts matrices
    of transfer functions only with slycot.
    """
    if isinstance(system, control.StateSpace):
        return system
    entries = [[siso(control.tf(system.num[i][j], system.den[i][j], system.dt)) for j in range(3)] for i in range(3)]
    order = sum(entry.nstates for row in entries for entry in row)
    a = scipy.linalg.block_diag(*[entry.A for row in entries for entry in row])
    b, c = np.zeros((order, 3)), np.zeros((3, order))
    at = 0
    for i, row in enumerate(entries):
        for j, entry in enumerate(row):
            b[at : at + entry.nstates, j : j + 1], c[i : i + 1, at : at + entry.nstates] = entry.B, entry.C
            at += entry.nstates
    return control.ss(a, b, c, np.array([[entry.D[0, 0] for entry in row] for row in entries]), system.dt)


def _sampled(system: control.StateSpace, period_s: float, method: str) -> control.StateSpace:
    if system.isctime(strict=True):
        return discretise(system, period_s, method)
    if system.dt is None:
        raise LawError("the law does not say whether it is continuous or discrete: set dt to 0 or to the period")
    if system.dt is not True and not math.isclose(system.dt, period_s, rel_tol=1e-9):
        raise LawError(
            f"the law has a period of {system.dt * 1e6:g} us and the bus {period_s * 1e6:g} us; "
            "sample it again, or hand it in continuous"
        )
    return system


def _likely_reason(law: DiscreteLaw, plant: LoopPlant) -> str:
    """What the user most likely did, if a change of sign or of gain makes the loop stable."""
    for factor, remedy in (
        (-1.0, "; with its sign turned round it is stable: w = -K (y - r), so K is positive against a deviation"),
        (0.1, "; with a tenth of its gain it is stable"),
        (0.01, "; with a hundredth of its gain it is stable"),
    ):
        other = DiscreteLaw(law.period_s, law.a, law.b, factor * law.c, factor * law.d)
        if margins(plant, other).stable:
            return remedy
    return "; no smaller gain and no other sign makes it stable"
