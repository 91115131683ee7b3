"""The predictive law as it is exported: what it has besides stands behind the records of every law, and its period is
composed with a plan. None of it is in a board's export of another law; the loop in C takes any law, over these records.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop import exchange, outputs, predictive_cycle
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.loop.predictive_cycle import PLANNER
from pkxyz_ctrl.loop.predictive_problem import PROBLEM, Problem

Records = NDArray[np.void]


def _before(record: np.dtype[Any], name: str, behind: np.dtype[Any]) -> np.dtype[Any]:
    return np.dtype([("own", record, (1,)), (name, behind, (1,))], align=True)


PLANNED_LAW = _before(cycling.LAW, "problem", PROBLEM)
PLANNED_MEMORY = _before(cycling.MEMORY, "planner", PLANNER)
PLANNED_EXCHANGE = _before(EXCHANGE, "problem", PROBLEM)
PLANNED_EXCHANGE_MEMORY = _before(EXCHANGE_MEMORY, "planner", PLANNER)
"""Each begins as the record whose place it takes; as law and cycle are the last of theirs, the last two end as the
first two do.
"""


def is_planned(law: Records) -> bool:
    """Whether a law (1,) of ``cycle.LAW`` plans."""
    return bool(law["tick"]["kind"][0] == PREDICTIVE)


def whole(config: Records) -> Records:
    """``config`` (1,) of ``EXCHANGE`` with all that its law goes by: itself, or (1,) of ``PLANNED_EXCHANGE``."""
    if config.dtype == PLANNED_EXCHANGE or not is_planned(config["law"][0]):
        return config
    made = np.zeros(1, PLANNED_EXCHANGE)
    made["own"], made["problem"] = config, Problem(config["law"][0]).record()
    return made


def memory_of(config: Records) -> Records:
    """Zeros for the memory that goes with it, (1,)."""
    return np.zeros(1, PLANNED_EXCHANGE_MEMORY if config.dtype == PLANNED_EXCHANGE else EXCHANGE_MEMORY)


def begins(records: Records, dtype: np.dtype[Any]) -> Records:
    """The record (1,) with which ``records`` (1,) begin, in the same place."""
    found: Records = records.view(np.uint8)[: dtype.itemsize].view(dtype)
    return found


@kernel
def cycle(law_array: Records, memory_array: Records, reference: Records) -> None:
    """``cycle.cycle`` of any law, over (1,) of ``PLANNED_LAW`` and of ``PLANNED_MEMORY``."""
    law, memory = law_array[0], memory_array[0]
    _cycle(law["own"], memory["own"], reference, law["problem"], memory["planner"])


@kernel
def period(config_array: Records, memory_array: Records, reference: Records, overrun: int) -> int:
    """``exchange.period`` of any law, over (1,) of ``PLANNED_EXCHANGE`` and of ``PLANNED_EXCHANGE_MEMORY``."""
    config, memory = config_array[0], memory_array[0]
    law, own = config["own"][0]["law"], memory["own"]
    was = exchange.hand_over(own, overrun)
    _cycle(law, own[0]["cycle"], reference, config["problem"], memory["planner"])
    outputs.decide(law, own[0]["cycle"], own[0]["outputs"], reference)
    left: int = exchange.take_over(own, was)
    return left


@kernel
def _cycle(law: Records, memory: Records, reference: Records, problem: Records, planner: Records) -> None:
    """With a plan where the law is one that plans; else nothing of the last two is touched, nor need be there."""
    if law[0]["tick"]["kind"] == PREDICTIVE:
        predictive_cycle.cycle(law, memory, reference, problem, planner)
    else:
        cycling.cycle(law, memory, reference)
