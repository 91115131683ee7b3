"""What comes before another law takes over (``pkxyz_ctrl.loop.law_change``) from the one by which a stage holds.

A linear law listens for a while, told which force is given in its place: its memory is then that of a law which has
given this force itself (Hanus, Kinnaert, Henrotte 1987).
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.core.demand import LINEAR, OPEN_LOOP, PREDICTIVE
from pkxyz_ctrl.core.linear_law import ORDER_MAX
from pkxyz_ctrl.loop import cycle as cycling

Array = NDArray[np.float64]
Records = NDArray[np.void]

NAME_BYTES = 32
OFFER = np.dtype([("number", "<u8"), ("name", f"S{NAME_BYTES}"), ("law", cycling.LAW)], align=True)
"""A law that was designed elsewhere, and what people call it."""

_SAME = ("geometry", "elasticity", "sense", "drive", "delay_periods")
_GIVES_LEAST = 0.99
"""So much of a force at rest a linear law has to be able to give by its memory alone."""


def objection(present: Records, new: Records) -> str | None:
    """Why a stage that works with one law (1,) of ``cycle.LAW`` can't be given another."""
    ours, theirs = present["tick"][0], new["tick"][0]
    kinds = {int(ours["kind"]), int(theirs["kind"])}
    if PREDICTIVE in kinds:
        return "a predictive law plans beside the tick and is begun with it: end, and serve with it"
    if OPEN_LOOP in kinds and len(kinds) > 1:
        return "open loop has no feedback that could take over the force: end, and serve with it"
    different = [name for name in _SAME if not _alike(present["tick"][name], new["tick"][name])]
    if different or present["period_us"][0] != new["period_us"][0]:
        named = ", ".join(different) or "period_us"
        return f"it is meant for another stage, bus or voltage limit ({named}): end, and serve with it"
    if theirs["kind"] == LINEAR and _gives_at_rest(theirs["linear"]) < _GIVES_LEAST:
        return "it has no integral action, so it can't take over the force that holds the stage"
    return None


def adapts_alike(present: Records, new: Records) -> bool:
    """Whether two laws (1,) learn in the same way, so that what was learnt goes on."""
    return _alike(present["tick"]["adaptation"], new["tick"]["adaptation"])


def _alike(one: Records, other: Records) -> bool:
    """Whether two records say the same; what lies between their fields is nothing."""
    return bool(np.all(one == other))


class Listening:
    """A linear law of ``new`` (1,) that does not act yet. ``x`` (ORDER_MAX,) is its memory, after ``ticks`` in a row.

    What holds the stage is the mean of the force that is fed back. A law that answers to noise from tick to tick does
    not hand that on, nor is it to end in the middle of it.
    """

    def __init__(self, new: Records, memory: Records) -> None:
        self._linear = new["tick"]["linear"][0]
        self._begin(memory)

    def _begin(self, memory: Records) -> None:
        self.x = np.zeros(ORDER_MAX)
        self._next = int(memory["tick_index"][0]) + 1
        self._expected_m = memory["tick"]["set_point_model"]["sample_m"][0, 0].copy()
        self.ticks = 0
        self._mean_n, self._square_n2, self._off_n = np.zeros(3), np.zeros(3), np.zeros(3)

    def listen(self, memories: Iterable[Records]) -> None:
        """So many ticks are over, and left these memories (1,)."""
        for memory in memories:
            self._listen(memory)

    def _listen(self, memory: Records) -> None:
        """x+ = A x + B e + U (w - w given), with w = -(C x + D e). After a missed one it begins anew."""
        if memory["tick_index"][0] != self._next:
            self._begin(memory)
            return
        self._next += 1
        linear, state = self._linear, memory["tick"][0]
        error = state["seen_m"] - self._expected_m
        self._expected_m[:] = state["set_point_model"]["sample_m"][0]
        w = -(linear["c"] @ self.x + linear["d"] @ error)
        self.ticks += 1
        fed_back_n = state["set_point_model"]["fed_back_n"]
        self._mean_n += (fed_back_n - self._mean_n) / self.ticks
        self._off_n = fed_back_n - self._mean_n
        self._square_n2 += (self._off_n**2 - self._square_n2) / self.ticks
        self.x = linear["a"] @ self.x + linear["b"] @ error + linear["unwind"] @ (w - self._mean_n)

    def is_calm(self, deviations: float) -> bool:
        """Whether the force of this tick is within so many of its standard deviations of its mean, in each axis."""
        return bool(np.all(self._off_n**2 <= deviations**2 * self._square_n2))


def _gives_at_rest(linear: np.void) -> float:
    """The least share of a steady force (3,) that a law's memory alone can give: w = -C x with x = A x."""
    order = int(linear["order"])
    a, c = linear["a"][:order, :order], linear["c"][:, :order]
    scale = 1e6 * np.abs(c).max()  # rest is what has to be met, by as much as there is; then the force
    rows = np.concatenate([(np.eye(order) - a) * scale, c])
    x = np.linalg.lstsq(rows, np.concatenate([np.zeros((order, 3)), -np.eye(3)]))[0]
    return float(np.linalg.svd(c @ x, compute_uv=False).min())
