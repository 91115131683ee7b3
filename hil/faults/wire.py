"""Faults of the bus and of the node, on the simulated wire: what becomes of a frame, and who else is there."""

import struct
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from hil.bus.clock import Lockstep
from hil.bus.disturbance import CORRUPTED, DROPPED, FrameFate
from hil.bus.endpoint import Endpoint
from hil.bus.wire import Wire
from hil.faults.channels import below, dice_of
from hil.faults.fault import Fault
from hil.faults.forged import Forger
from hil.faults.frame_rules import RULE, meets
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.compiled.direct_call import direct

Act = Callable[[Frame], FrameFate]

SENDERS: Final = ("controller", "amplifier")
"""Names on the wire, by the number that a rule knows them by."""
_DICE_SOURCE = (1 << 16) + 1  # of the seed's streams: none of the plant's own
_SYNC_ID = 0x080
_EVERY_ID = 0, (1 << 29) - 1
_HEARTBEAT_IDS = 0x701, 0x77F
_IDENTITY = (0x1018, 2)
_DOWNLOAD = struct.Struct("<BHBI")  # SDO, expedited


class WireFaults:
    """The faults of bus and node on one wire. ``arm`` makes the appointments; until then nothing is touched.

    ``count`` of ``rules`` (n,) of ``RULE`` are on, in the order in which they began, and ``dice`` (1,) of ``DICE`` is
    what they roll.
    """

    def __init__(
        self, faults: Sequence[Fault], clock: Lockstep, wire: Wire, node: AmplifierNode, driver: DriverConfig, seed: int
    ) -> None:
        self._faults = [f for f in faults if f.family in ("bus", "node") or f.kind == "trip"]
        self._clock = clock
        self._wire = wire
        self._node = node
        self._driver = driver
        self.rules = np.zeros(len(self._faults), RULE)
        self.dice = dice_of(seed, _DICE_SOURCE)
        self.count = 0
        self._ruling: list[tuple[Fault, Act]] = []  # the faults of ``rules``, and what each does
        self._meets = direct(meets, self.rules, self.dice, 0, 0, 0)
        self._below = direct(below, self.dice["words"][0], 0)
        self._rebooting: set[int] = set()  # by the identity of the fault
        self._guests: dict[int, Endpoint] = {}
        self._forgers: dict[int, Forger] = {}
        self._product_code = node.od[_IDENTITY]
        self._ids = {
            "sense": 0x280 + driver.node_id,
            "drive": 0x300 + driver.node_id,
            "sync": _SYNC_ID,
        }

    def before_power_on(self) -> None:
        """What is wrong before the node is switched on."""
        for fault in self._faults:
            if fault.kind == "wrong_identity" and fault.at_us == 0:
                self._install_identity(round(fault["product_code"]))

    def arm(self, origin_us: int) -> None:
        """Every fault at its time after ``origin_us``, the first tick."""
        for fault in self._faults:
            self._clock.call_at(origin_us + fault.at_us, lambda fault=fault: self._begin(fault))  # type: ignore[misc]
            if fault.end_us is not None:
                self._clock.call_at(origin_us + fault.end_us, lambda fault=fault: self._end(fault))  # type: ignore[misc]

    # -- begin and end ----------------------------------------------------------------------------------------------

    def _begin(self, fault: Fault) -> None:
        match fault.kind:
            case "trip":
                self._node.amplifier_fault(round(fault["code"]))
            case "reset":
                self._node.power_on()
            case "reboot_loop":
                self._rebooting.add(id(fault))
                self._reboot(fault)
            case "wrong_identity":
                self._install_identity(round(fault["product_code"]))
                if fault.at_us > 0:
                    self._node.power_on()
            case "wrong_configuration":  # who has written leaves: a guest keeps ticks from being whole
                guest = self._plug_in(fault, lambda sent, t_us: self._clock.call_at(t_us, lambda: self._unplug(fault)))
                guest.send(self._frame(0x600 + self._driver.node_id, _download(fault)))
            case "forged":
                self._forgers[id(fault)] = Forger(
                    f"guest {self._faults.index(fault)}", fault.part, round(fault["interval_s"] * 1e6),
                    self._driver, self._clock, self._wire,
                )  # fmt: skip
            case "babbling":
                self._babble(fault)
            case _:
                self._rule([*self._ruling, (fault, self._act_of(fault))])

    def _end(self, fault: Fault) -> None:
        match fault.kind:
            case "trip":
                self._node.clear_amplifier_fault(round(fault["code"]))
            case "wrong_identity":
                self._install_identity(self._product_code)
                self._node.power_on()
        self._rebooting.discard(id(fault))
        if any(other is fault for other, _ in self._ruling):
            self._rule([(other, act) for other, act in self._ruling if other is not fault])
        forger = self._forgers.pop(id(fault), None)
        if forger is not None:
            forger.leave()
        self._unplug(fault)

    def _install_identity(self, product_code: object) -> None:
        self._node.od.install(*_IDENTITY, product_code)  # type: ignore[arg-type]

    def _reboot(self, fault: Fault) -> None:
        if id(fault) in self._rebooting:
            self._node.power_on()
            self._clock.call_at(self._clock.now_us + round(fault["interval_s"] * 1e6), lambda: self._reboot(fault))

    # -- others on the bus ------------------------------------------------------------------------------------------

    def _plug_in(self, fault: Fault, on_sent: Callable[[Frame, int], object] | None = None) -> Endpoint:
        guest = self._wire.attach(f"guest {self._faults.index(fault)}", lambda frame, t_us: None, on_sent=on_sent)
        self._guests[id(fault)] = guest
        return guest

    def _unplug(self, fault: Fault) -> None:
        guest = self._guests.pop(id(fault), None)
        if guest is not None:
            guest.detach()

    def _babble(self, fault: Fault) -> None:
        frame = self._frame(round(fault["identifier"]), bytes(8))
        guest = self._plug_in(fault, lambda sent, t_us: guest.send(frame))
        guest.send(frame)

    def _frame(self, can_id: int, data: bytes) -> Frame:
        return Frame(can_id, data, self._driver.fd, self._driver.fd)

    # -- what becomes of a frame ------------------------------------------------------------------------------------

    def _rule(self, ruling: list[tuple[Fault, Act]]) -> None:
        """From now on these are on."""
        self._ruling, self.count = ruling, len(ruling)
        for place, (fault, _) in enumerate(ruling):
            rule = self.rules[place]
            rule["low_id"], rule["high_id"] = self._concerns(fault)
            rule["sender"] = SENDERS.index("amplifier") if fault.kind == "silent" else -1
            rule["is_certain"] = fault.kind in ("silent", "reorder", "delay")
            rule["is_loss"] = fault.kind in ("drop", "silent")
            rule["share"] = 1.0 if rule["is_certain"] else fault["probability"]
        self._wire.disturbance.set_tap(self.judge if ruling else None)

    def judge(self, frame: Frame, sender: str, t_us: int) -> FrameFate | None:
        """What becomes of a frame; None: nothing happens to it."""
        number = SENDERS.index(sender) if sender in SENDERS else len(SENDERS)
        place = self._meets(self.rules, self.dice, self.count, frame.can_id, number)
        return None if place < 0 else self._ruling[place][1](frame)

    def _act_of(self, fault: Fault) -> Act:
        match fault.kind:
            case "duplicate":
                return lambda frame: FrameFate(deliveries=((0, frame), (0, frame)))
            case "reorder":
                return _Swapping()
            case "corrupt":
                return lambda frame: FrameFate(deliveries=((0, self._with_a_bit_flipped(frame)),))
            case "delay":
                delay_us = round(fault["delay_us"])
                return lambda frame: FrameFate(deliveries=((delay_us, frame),))
            case "error_frames":
                return lambda frame: CORRUPTED
        return lambda frame: DROPPED  # drop, silent

    def _concerns(self, fault: Fault) -> tuple[int, int]:
        """The lowest and the highest identifier of its frames."""
        if not fault.part:
            return _EVERY_ID
        if fault.part == "heartbeat":
            return _HEARTBEAT_IDS
        return self._ids[fault.part], self._ids[fault.part]

    def _with_a_bit_flipped(self, frame: Frame) -> Frame:
        if not frame.data:
            return frame
        bit = self._below(self.dice["words"][0], 8 * len(frame.data))
        flipped = bytearray(frame.data)
        flipped[bit // 8] ^= 1 << bit % 8
        return frame._replace(data=bytes(flipped))


def _download(fault: Fault) -> bytes:
    """The SDO request that writes what the fault says."""
    command = 0x23 | 4 - round(fault["bytes"]) << 2
    return _DOWNLOAD.pack(command, round(fault["index"]), round(fault["subindex"]), round(fault["value"]))


class _Swapping:
    """Holds every other frame of a kind back, until the one behind it has gone."""

    def __init__(self) -> None:
        self._held: dict[int, Frame] = {}  # by identifier

    def __call__(self, frame: Frame) -> FrameFate:
        held = self._held.pop(frame.can_id, None)
        if held is None:
            self._held[frame.can_id] = frame
            return DROPPED
        return FrameFate(deliveries=((0, frame), (0, held)))
