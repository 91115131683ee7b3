"""Faults of the bus and of the node, on the simulated wire: what becomes of a frame, and who else is there."""

import random
import struct
from collections.abc import Callable, Sequence

from hil.bus.clock import Lockstep
from hil.bus.disturbance import CORRUPTED, DROPPED, FrameFate
from hil.bus.endpoint import Endpoint
from hil.bus.wire import Wire
from hil.faults.fault import Fault
from hil.faults.forged import Forger
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import Frame

Rule = Callable[[Frame, str, int], FrameFate | None]

_SYNC_ID = 0x080
_IDENTITY = (0x1018, 2)
_DOWNLOAD = struct.Struct("<BHBI")  # SDO, expedited


class WireFaults:
    """The faults of bus and node on one wire. ``arm`` makes the appointments; until then nothing is touched."""

    def __init__(
        self, faults: Sequence[Fault], clock: Lockstep, wire: Wire, node: AmplifierNode, driver: DriverConfig, seed: int
    ) -> None:
        self._faults = [f for f in faults if f.family in ("bus", "node") or f.kind == "trip"]
        self._clock = clock
        self._wire = wire
        self._node = node
        self._driver = driver
        self._random = random.Random(seed)
        self._rules: dict[int, Rule] = {}  # those that are on, by the identity of the fault
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
                self._rules[id(fault)] = lambda frame, sender, t_us: None  # its presence says that it is on
                self._reboot(fault)
            case "wrong_identity":
                self._install_identity(round(fault["product_code"]))
                if fault.at_us > 0:
                    self._node.power_on()
            case "wrong_configuration":
                guest = self._plug_in(fault)
                guest.send(self._frame(0x600 + self._driver.node_id, _download(fault)))
            case "forged":
                self._forgers[id(fault)] = Forger(
                    f"guest {self._faults.index(fault)}", fault.part, round(fault["interval_s"] * 1e6),
                    self._driver, self._clock, self._wire,
                )  # fmt: skip
            case "babbling":
                self._babble(fault)
            case _:
                self._rules[id(fault)] = self._rule_of(fault)
                self._wire.disturbance.set_tap(self._judge)

    def _end(self, fault: Fault) -> None:
        match fault.kind:
            case "trip":
                self._node.clear_amplifier_fault(round(fault["code"]))
            case "wrong_identity":
                self._install_identity(self._product_code)
                self._node.power_on()
        self._rules.pop(id(fault), None)
        forger = self._forgers.pop(id(fault), None)
        if forger is not None:
            forger.leave()
        guest = self._guests.pop(id(fault), None)
        if guest is not None:
            guest.detach()
        if not any(f.family == "bus" or f.kind == "silent" for f in self._faults if id(f) in self._rules):
            self._wire.disturbance.set_tap(None)

    def _install_identity(self, product_code: object) -> None:
        self._node.od.install(*_IDENTITY, product_code)  # type: ignore[arg-type]

    def _reboot(self, fault: Fault) -> None:
        if id(fault) in self._rules:
            self._node.power_on()
            self._clock.call_at(self._clock.now_us + round(fault["interval_s"] * 1e6), lambda: self._reboot(fault))

    # -- others on the bus ------------------------------------------------------------------------------------------

    def _plug_in(self, fault: Fault, on_sent: Callable[[Frame, int], object] | None = None) -> Endpoint:
        guest = self._wire.attach(f"guest {self._faults.index(fault)}", lambda frame, t_us: None, on_sent=on_sent)
        self._guests[id(fault)] = guest
        return guest

    def _babble(self, fault: Fault) -> None:
        frame = self._frame(round(fault["identifier"]), bytes(8))
        guest = self._plug_in(fault, lambda sent, t_us: guest.send(frame))
        guest.send(frame)

    def _frame(self, can_id: int, data: bytes) -> Frame:
        return Frame(can_id, data, self._driver.fd, self._driver.fd)

    # -- what becomes of a frame ------------------------------------------------------------------------------------

    def _judge(self, frame: Frame, sender: str, t_us: int) -> FrameFate | None:
        for rule in self._rules.values():
            outcome = rule(frame, sender, t_us)
            if outcome is not None:
                return outcome
        return None

    def _rule_of(self, fault: Fault) -> Rule:
        if fault.kind == "silent":
            return lambda frame, sender, t_us: DROPPED if sender == "amplifier" else None
        concerns = self._concerns(fault)
        if fault.kind == "reorder":
            return _Swapping(concerns)
        dice = self._random
        acts: dict[str, Callable[[Frame], FrameFate]] = {
            "drop": lambda frame: DROPPED,
            "duplicate": lambda frame: FrameFate(deliveries=((0, frame), (0, frame))),
            "corrupt": lambda frame: FrameFate(deliveries=((0, self._with_a_bit_flipped(frame)),)),
            "delay": lambda frame: FrameFate(deliveries=((round(fault["delay_us"]), frame),)),
            "error_frames": lambda frame: CORRUPTED,
        }
        act = acts[fault.kind]
        share = 1.0 if fault.kind == "delay" else fault["probability"]
        return lambda frame, sender, t_us: act(frame) if concerns(frame) and dice.random() < share else None

    def _concerns(self, fault: Fault) -> Callable[[Frame], bool]:
        if not fault.part:
            return lambda frame: True
        if fault.part == "heartbeat":
            return lambda frame: 0x700 < frame.can_id < 0x780
        wanted = self._ids[fault.part]
        return lambda frame: frame.can_id == wanted

    def _with_a_bit_flipped(self, frame: Frame) -> Frame:
        if not frame.data:
            return frame
        bit = self._random.randrange(8 * len(frame.data))
        flipped = bytearray(frame.data)
        flipped[bit // 8] ^= 1 << bit % 8
        return frame._replace(data=bytes(flipped))


def _download(fault: Fault) -> bytes:
    """The SDO request that writes what the fault says."""
    command = 0x23 | 4 - round(fault["bytes"]) << 2
    return _DOWNLOAD.pack(command, round(fault["index"]), round(fault["subindex"]), round(fault["value"]))


class _Swapping:
    """Holds every other frame of a kind back, until the one behind it has gone."""

    def __init__(self, concerns: Callable[[Frame], bool]) -> None:
        self._concerns = concerns
        self._held: dict[int, Frame] = {}  # by identifier

    def __call__(self, frame: Frame, sender: str, t_us: int) -> FrameFate | None:
        if not self._concerns(frame):
            return None
        held = self._held.pop(frame.can_id, None)
        if held is None:
            self._held[frame.can_id] = frame
            return DROPPED
        return FrameFate(deliveries=((0, frame), (0, held)))
