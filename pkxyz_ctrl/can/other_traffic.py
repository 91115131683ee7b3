"""Frames on the bus that are not the amplifier's: counted, so that a fault which they cause can name them."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]

_FLOOD_FRAMES: Final = 5  # fewer say nothing
_FLOOD_PER_S: Final = (
    2000  # more than this, on average, since the amplifier was last heard; a full classic bus has 9000
)
_COUNTABLE: Final = 1 << 30
_EMCY, _SDO, _HEARTBEAT = cob_id.EMCY_BASE, cob_id.SDO_RESPONSE_BASE, cob_id.HEARTBEAT_BASE

TRAFFIC = np.dtype(
    [
        ("since_us", "i8"),  # all was well
        ("last_us", "i8"),  # the last one came
        ("frames", "i4"),  # so many since then
        ("can_id", "i4"),  # which most of them have, if one has most
        ("lead", "i4"),  # of that one over all others, in frames
    ],
    align=True,
)


@kernel
def note(traffic: Records, node_id: int, sense_id: int, can_id: int, t_us: int) -> None:
    """A frame that was read at ``t_us`` and was not a sense frame. Which identifier has the majority follows from one
    counter (Boyer and Moore, 1981).
    """
    if can_id == sense_id or can_id == _EMCY + node_id:
        return
    if can_id == _SDO + node_id or can_id == _HEARTBEAT + node_id:
        return
    seen = traffic[0]
    if seen["lead"] == 0:
        seen["can_id"] = can_id
    seen["lead"] += 1 if seen["can_id"] == can_id else -1
    if seen["frames"] < _COUNTABLE:
        seen["frames"] += 1
    seen["last_us"] = t_us


@kernel
def forget(traffic: Records, t_us: int) -> None:
    """All is well at ``t_us``."""
    traffic[0]["frames"] = traffic[0]["lead"] = 0
    traffic[0]["since_us"] = t_us


def complaint(traffic: np.void) -> str:
    """``; the bus is flooded: ...`` where others send so much that the amplifier may go unheard, else empty."""
    count, time_us = int(traffic["frames"]), int(traffic["last_us"]) - int(traffic["since_us"])
    if count < _FLOOD_FRAMES or count * 1_000_000 < _FLOOD_PER_S * time_us:
        return ""
    return (
        f"; the bus is flooded: {count} frames that are not the amplifier's in {time_us / 1000:.3g} ms, most of "
        f"them 0x{int(traffic['can_id']):03X}: silence their sender"
    )
