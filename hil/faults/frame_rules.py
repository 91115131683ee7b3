"""Which faults of the wire meet a frame, compiled: the same dice event by event and in whole ticks."""

import numpy as np
from numpy.typing import NDArray

from hil.faults.channels import chance
from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]

RULE = np.dtype(
    [
        ("low_id", "i4"),  # identifiers that it concerns, both included
        ("high_id", "i4"),
        ("sender", "i4"),  # whose frames it concerns; -1: everybody's
        ("is_certain", "i4"),  # 1: it meets each of them, and rolls no dice
        ("is_loss", "i4"),  # 1: nobody gets a frame that it meets
        ("share", "f8"),  # of them that it meets
    ],
    align=True,
)


@kernel
def meets(rules: Records, dice: Records, count: int, can_id: int, sender: int) -> int:
    """The first of ``count`` rules that meets a frame, -1 if none does."""
    for n in range(count):
        rule = rules[n]
        if not rule["low_id"] <= can_id <= rule["high_id"] or (rule["sender"] >= 0 and rule["sender"] != sender):
            continue
        if rule["is_certain"] != 0 or chance(dice[0]["words"]) < rule["share"]:
            return n
    return -1
