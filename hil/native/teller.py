"""The words for what a native loop did: a controller that is never run, and remembers what the loop's remembered."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes.setup import Setup
from hil.lanes.wall import wall_gate
from pkxyz_ctrl.can.driver import bytes_of
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.export.planned import begins, whole
from pkxyz_ctrl.export.shared import EVENTS, Told
from pkxyz_ctrl.io.can_port import complaint_of, refusal_of
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.exchange import NOT_RESTARTED
from pkxyz_ctrl.loop.row import TRUTH_FIELDS

Records = NDArray[np.void]


class Teller(Controller):
    """``faults`` grows as ``take`` reads events; after ``remember`` the rest of a controller's words hold, too."""

    def __init__(self, setup: Setup) -> None:
        self._port: np.void | None = None
        super().__init__(setup.law, setup.bus, wall_gate(setup.gate), _nowhere, port_complaint=lambda: self.complaint)
        self.outputs[0] = setup.new_outputs()[0]
        for name, *_ in TRUTH_FIELDS:
            self.memory["row"][name] = np.nan  # nobody here knows it

    def _load_kernels(self) -> None:
        """None: what would run them is the loop."""

    @property
    def complaint(self) -> str:
        """What stands in the way of frames, as ``CanPort.complaint``."""
        port = self._port
        if port is None:
            return ""
        return complaint_of(bool(port["is_bus_off"]), refusal_of(int(port["refusal"])) if port["refuses"] else "")

    def lay_out(self, shared: Any) -> None:
        """Write what the loop begins with into a record of ``SHARED``."""
        config = whole(self.record)
        begins(shared["config"], config.dtype)[:] = config
        shared["memory"]["own"] = self.exchange

    def remember(self, memory: Records, port: np.void) -> None:
        """Take over what the loop remembers: (1,) of ``EXCHANGE_MEMORY``, and ``PORT``."""
        self.exchange[0], self._port = memory[0], port.copy()

    def take(self, events: np.void) -> None:
        """Read what is there of ``EVENTS_RING``, and put it into words."""
        while events["tail"] < events["head"]:
            event = events["event"][int(events["tail"]) % EVENTS]
            self.remember(event["memory"], event["port"][0])
            self._tell(Told(int(event["kind"])), int(event["told"]), event["frame"][0], int(event["t_us"]))
            events["tail"] += 1

    def _tell(self, kind: Told, told: int, frame: np.void, t_us: int) -> None:
        if kind == Told.FAULT:
            self._enter()
        elif kind == Told.EMERGENCY:
            data = bytes_of(int(frame["data"]), min(int(frame["length"]), 8))
            self.driver.told(Frame._make((int(frame["can_id"]), data, int(frame["flags"]))), told, t_us)
        else:
            self._pass_on(told, t_us)
            if told & NOT_RESTARTED:
                self._not_restarted()


def _nowhere(frame: Frame) -> None:
    """The loop has sent it."""
