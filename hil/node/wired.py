"""The amplifier node that a bus file describes."""

from collections.abc import Callable

from hil.node.alarm import Scheduler
from hil.node.amplifier import AmplifierNode
from hil.node.digital import Switch
from hil.node.sense import Plant
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.config.files import CONFIG_DIR

EDS = CONFIG_DIR / "comb_amplifier.eds"
"""What the shipped node, and the driver's wire contract, follow."""


def wired_node(
    can: CanConfig,
    clock: Scheduler,
    send: Callable[[Frame], object],
    plant: Plant,
    node_type: type[AmplifierNode] = AmplifierNode,
    switch: Switch = lambda bits, t_us: None,
) -> AmplifierNode:
    """Node between ``send`` and ``plant``, not yet powered on. ``node_type``: one with a defect, say; ``switch`` is
    told what its digital outputs put out.
    """
    return node_type(
        can.driver.node_id, clock, send, plant, EDS,
        turnaround_us=can.turnaround_us, fd=can.driver.fd, protection=can.driver.protection, switch=switch,
    )  # fmt: skip
