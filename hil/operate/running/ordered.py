"""A native loop as a session sees it: what the last tick left, and orders for the next."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes.setup import Setup
from hil.native.teller import Teller
from hil.operate.running.sheets import Sheets
from pkxyz_ctrl.export.shared import OBEYED, SNAPSHOTS, Order
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop import outputs
from pkxyz_ctrl.loop.exchange import EXCHANGE_MEMORY
from pkxyz_ctrl.safety.modes import Event

Records = NDArray[np.void]

_CYCLE_AT = int(dict(EXCHANGE_MEMORY.fields or {})["cycle"][1])


class Ordered(Teller):
    """``operate.loop.Loop``. What is asked for is collected until ``hand_in``; the loop answers in its next tick, and
    until then nothing more may be asked for. ``seen``: number of the tick that everything is as of.
    """

    def __init__(self, setup: Setup, shared: Any) -> None:
        """``shared``: a record of ``SHARED``, mapped."""
        self._events, self._operated = shared["events"][0], shared["operated"][0]
        self._orders, self._obeyed = self._operated["orders"][0], np.zeros(1, OBEYED)[0]
        self._bits = self._handed_in = self._number = 0
        self._change: Records | None = None
        self._wanted = np.zeros(1, outputs.OUTPUTS)
        self._is_law_refused = False
        self.seen = self._stepped = self._before = 0
        super().__init__(setup)
        self._own = self.exchange.view(np.uint8)
        self._change_bytes = np.atleast_1d(self._operated["change"]).view(np.uint8)
        slots = self._operated["snapshots"]
        self._snapshots = [(slot, slot["port"][0], np.atleast_1d(slot["memory"]).view(np.uint8)) for slot in slots]

    # -- what is so ---------------------------------------------------------------------------------------------------

    def look(self) -> bool:
        """Take over what the newest tick left, and put into words what happened; whether there was one."""
        self.take(self._events)
        newest = int(self._operated["newest"])
        if newest == self.seen:
            return False
        slot, port, memory = self._snapshots[newest % SNAPSHOTS]
        self._own[:] = memory
        self._port, self._obeyed = port.copy(), slot["obeyed"][0].copy()
        if int(slot["begun"]) != newest:  # being written over: the next one comes soon
            return False
        self.seen = newest
        return True

    def present_row(self) -> int:
        """Row of the reference that the loop is at by now, if it tracks."""
        return int(self.memory["reference_tick"][0]) + int(self._operated["newest"]) - self.seen

    def answered(self, setpoints: Sheets) -> bool:
        """Whether the loop has answered all orders, and none of them has to be given again."""
        if int(self._obeyed["number"]) != self._number:
            return False
        handed_in, refused, self._handed_in = self._handed_in, int(self._obeyed["refused"]) & self._handed_in, 0
        if handed_in & Order.LAW:
            self._is_law_refused = bool(refused & Order.LAW)
            if not self._is_law_refused and self._change is not None:
                self.law[0] = self._change["law"][0]
        if refused & Order.SHEET:
            setpoints.refused(int(self.memory["reference_tick"][0]), int(self._obeyed["late_rows"]))
            return False
        setpoints.answered(int(self._obeyed["late_rows"]))
        self._before, self._stepped = self._stepped, self.seen
        return True

    def passed(self) -> Iterator[Records]:
        for number in range(max(self._before, self.seen - SNAPSHOTS + 2) + 1, self.seen + 1):
            slot, _, memory = self._snapshots[number % SNAPSHOTS]
            left = memory[_CYCLE_AT : _CYCLE_AT + cycling.MEMORY.itemsize].copy()
            if int(slot["begun"]) == number:
                yield left.view(cycling.MEMORY)

    @property
    def is_obeyed(self) -> bool:
        return not ((self._bits | self._handed_in) & Order.LAW or self._is_law_refused)

    # -- what is asked for --------------------------------------------------------------------------------------------

    def request(self, event: Event) -> None:
        self._orders["event"] = event
        self._bits |= Order.REQUEST

    def clear(self) -> None:
        self._bits |= Order.CLEAR

    def release(self) -> None:
        self._bits |= Order.RELEASE

    def hold_quietly(self, quiet: bool) -> None:
        self._orders["quiet"] = quiet
        self._bits |= Order.QUIET

    def settle(self, window_m: float, sigmas: float, dwell_s: float) -> None:
        outputs.settle(self._wanted, window_m, sigmas, dwell_s, self.period_us * 1e-6)
        for name in ("window_m", "sigmas", "dwell_ticks"):
            self._orders[name] = self._wanted[name][0]
        self._bits |= Order.SETTLE

    def aim(self, axis: int, direction: int, start_m: float, pitch_m: float, count: int) -> None:
        orders = self._orders
        orders["axis"], orders["direction"], orders["count"] = axis, direction, count
        orders["start_m"], orders["pitch_m"] = start_m, pitch_m
        self._bits |= Order.AIM

    def change_law(self, change: Records) -> None:
        self._change = change
        self._change_bytes[:] = change.view(np.uint8)
        self._orders["tick"] = self.memory["tick_index"][0]
        self._bits |= Order.LAW

    def hand_in(self, setpoints: Sheets) -> None:
        """Everything that was asked for since the last time, if anything was."""
        orders = self._orders
        if setpoints.changed_from is not None:
            orders["changed_from"], orders["sheet"] = setpoints.changed_from, setpoints.page
            self._bits |= Order.SHEET
        if self._bits:
            orders["bits"] = self._handed_in = self._bits
            self._bits = 0
            self._number += 1
            orders["number"] = self._number
        self._operated["looked"] = self.seen
