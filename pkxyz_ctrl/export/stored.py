"""What of the two records a board has to hold for a law: what only other laws have stands last, and stays away."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.core import tick
from pkxyz_ctrl.core.adaptation import ADAPTATION_STATE, AGES
from pkxyz_ctrl.core.demand import LINEAR, PREDICTIVE
from pkxyz_ctrl.core.linear_law import LINEAR_LAW
from pkxyz_ctrl.core.youla import YOULA_STATE
from pkxyz_ctrl.export.planned import PLANNED_LAW, PLANNED_MEMORY
from pkxyz_ctrl.loop import active_set
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.loop.predictive_cycle import PLANNER
from pkxyz_ctrl.loop.predictive_problem import PROBLEM

Records = NDArray[np.void]

_WORD = 8


class Stored(NamedTuple):
    """Bytes from the beginning of a record on, a multiple of eight: of its law or settings, and of its memory."""

    settings: int
    memory: int


def stored(law: Records) -> Stored:
    """Of ``cycle.LAW`` and ``cycle.MEMORY``, for a ``law`` (1,); or of ``PLANNED_LAW`` and ``PLANNED_MEMORY``."""
    numbers = law[0]["tick"]
    rows = int(numbers["linear"]["order"]) if numbers["kind"] == LINEAR else 0
    linear_at = _at(cycling.LAW, "tick") + _at(tick.LAW, "linear")
    row_bytes = LINEAR_LAW["a"].itemsize // LINEAR_LAW["a"].shape[0]
    settings = linear_at + _at(LINEAR_LAW, "a") + rows * row_bytes if rows else linear_at
    if numbers["kind"] == PREDICTIVE:
        return _stored_planned(int(numbers["predictive"]["horizon"]))
    last = _at(cycling.MEMORY, "tick")
    if numbers["adaptation"]["on"] != 0:
        ages = int(numbers["delay_periods"]) + 1
        age_bytes = ADAPTATION_STATE["force_n"].itemsize // AGES
        memory = last + _at(tick.MEMORY, "adaptation") + _at(ADAPTATION_STATE, "force_n") + ages * age_bytes
    elif numbers["youla"]["taps"] > 0:
        memory = last + _at(tick.MEMORY, "adaptation")
    else:
        memory = last + _at(tick.MEMORY, "youla") + _at(YOULA_STATE, "innovation_m")
    return Stored(_whole(settings), _whole(memory))


def _stored_planned(horizon: int) -> Stored:
    """All of the records of every law, and behind them what such a horizon needs of problem and planner."""
    program, work = active_set.used_bytes(9 * horizon - 3, 3 * horizon + 1)
    return Stored(
        _whole(_at(PLANNED_LAW, "problem") + _at(PROBLEM, "program") + program),
        _whole(_at(PLANNED_MEMORY, "planner") + _at(PLANNER, "work") + work),
    )


def stored_in_exchange(law: Records) -> Stored:
    """Of ``EXCHANGE`` and ``EXCHANGE_MEMORY``, of which law and memory are the last."""
    settings, memory = stored(law)
    return Stored(_at(EXCHANGE, "law") + settings, _at(EXCHANGE_MEMORY, "cycle") + memory)


def _at(record: np.dtype[np.void], field: str) -> int:
    return int(dict(record.fields or {})[field][1])


def _whole(size: int) -> int:
    return -(-size // _WORD) * _WORD
