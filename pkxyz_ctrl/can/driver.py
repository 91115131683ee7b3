"""The controller's side of the connection to the amplifier: frames in, frames out, time passed in.

No clock, no socket, no thread. The start-up dialogue is driven by ``start``, ``receive`` and ``poll``; once
``state`` is OPERATIONAL the loop calls ``sync``, ``receive``, ``sense.take``, ``drive`` and ``heartbeat_due``. What
happens is compiled, in ``start_sequence`` and ``driver_rules``; here are its settings and its words.
"""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.direct_call import direct

from . import cob_id, driver_rules, start_sequence
from .cob_id import state_name
from .codec import Counts, ProcessCodec
from .driver_config import DriverConfig
from .driver_rules import (
    DRIVER,
    DRIVER_MEMORY,
    FOREIGN_FRAME,
    NODE_EMERGENCY,
    NODE_HEARTBEAT_LOST,
    NODE_NOT_OPERATIONAL,
    NODE_REBOOTED,
    SAFETY_OBJECTS,
    DriverState,
    Failure,
)
from .emergency import Emergency, decode_emergency
from .frame import FD_FAST, Frame
from .process_pdo import pdo_record
from .sense_input import SenseInput
from .startup import Setting, failure_words, lost, never_booted, start_record, table

__all__ = [
    "FOREIGN_FRAME", "NODE_EMERGENCY", "NODE_HEARTBEAT_LOST", "NODE_NOT_OPERATIONAL", "NODE_REBOOTED",
    "SAFETY_OBJECTS", "AmplifierDriver", "DriverState",
]  # fmt: skip

Frames = tuple[Frame, ...]
Records = NDArray[np.void]

HEAD: Final = 8  # bytes of a frame that the rules look at: nothing that matters is longer
_NOTHING: Frames = ()
_EMERGENCIES_KEPT = 64
_STATES = {state.value: state for state in DriverState}


def word_of(data: bytes) -> int:
    """The first eight bytes as the rules read them."""
    return int.from_bytes(data[:HEAD], "little", signed=True)


def bytes_of(word: int, length: int) -> bytes:
    """``length`` bytes, 0..8, of a number that the rules made."""
    return (word & 0xFFFF_FFFF_FFFF_FFFF).to_bytes(HEAD, "little")[:length]


class AmplifierDriver:
    """Starts, feeds and watches one amplifier node (CiA 301 master services that it needs, CiA 401 PDOs).

    ``state`` and ``failure`` (a sentence: what was expected, what came, what to do) tell how the connection fares.
    ``node_events`` (NODE_... bits) are latched: EMERGENCY until ``acknowledge``, the others until ``start``, because a
    node that was silent, left the operational state or restarted has to be configured again, and so has one to which
    somebody else spoke in our name (FOREIGN_FRAME; ``foreign`` tells the first such frame). ``emergencies`` holds
    the last 64. ``sense`` holds this tick's sense values. ``count_step_max``: the node's own limit of a step at a SYNC,
    in drive counts. All times are integer microseconds of the caller's one clock and never run backwards.

    ``record`` (1,) of ``driver_rules.DRIVER`` is what the rules go by, ``memory`` (1,) of ``DRIVER_MEMORY`` all that
    they remember.
    """

    def __init__(
        self,
        config: DriverConfig,
        count_step_max: int = 32767,
        settings: tuple[Setting, ...] = (),
        record: Records | None = None,
        memory: Records | None = None,
        *,
        period_us: int = 1000,
        short_frame_us: int = 65,
    ) -> None:
        """``settings``: what the start-up goes by, in place of ``startup.table``; ``record`` and ``memory``: where they
        are to stand. ``period_us`` of the loop; ``short_frame_us``: what a frame of one byte takes at most.
        """
        self.config = config
        self._settings = settings if settings else table(config, count_step_max)
        self.emergencies: deque[Emergency] = deque(maxlen=_EMERGENCIES_KEPT)
        self.drive_id = cob_id.drive(config.node_id, config.drive_pdo)
        self.record = np.zeros(1, DRIVER) if record is None else record
        self.memory = np.zeros(1, DRIVER_MEMORY) if memory is None else memory
        codec = ProcessCodec(cob_id.sense(config.node_id, config.sense_pdo), config.protection)
        self.sense = SenseInput(codec, record=self.record["sense"][0], memory=self.memory["sense"][0])
        self._drive_codec = ProcessCodec(self.drive_id, config.protection)
        self._ours = {
            cob_id.NMT: "an NMT command",
            cob_id.SYNC: "a SYNC",
            self.drive_id: "a drive PDO",
            cob_id.SDO_REQUEST_BASE + config.node_id: "an SDO request",
            cob_id.HEARTBEAT_BASE + config.controller_node_id: "a controller's heartbeat",
            cob_id.OUTPUT_BASE + config.node_id: "an RPDO 1",
        }
        self._flags = FD_FAST if config.fd else 0
        self._configure()
        self.record["period_us"], self.record["short_frame_us"] = period_us, short_frame_us
        driver_rules.switch_on(self.memory)
        c, m = self.record, self.memory
        self._start = direct(start_sequence.begin, c, m, 0)
        self._poll = direct(start_sequence.poll, c, m, 0)
        self._sync, self._heartbeat = direct(driver_rules.sync, c, m, 0), direct(driver_rules.heartbeat, c, m, 0)
        self._receive = direct(start_sequence.on_frame, c, m, *[0] * 5)
        self._drive = direct(driver_rules.drive, c, m, *[0] * 3)

    def _configure(self) -> None:
        config, to = self.config, self.record[0]
        to["drive"] = pdo_record(self.drive_id, config.protection)
        to["start"] = start_record(config, self._settings)
        to["node_id"], to["flags"] = config.node_id, self._flags
        to["our_heartbeat_id"] = cob_id.HEARTBEAT_BASE + config.controller_node_id
        to["output_id"], to["signature_id"] = config.output_id, config.signature_id
        to["signature_syncs"] = config.signature_syncs
        to["heartbeat_wait_us"] = config.heartbeat_wait_us
        to["heartbeat_period_us"] = 1000 * config.controller_heartbeat_period_ms
        to["node_period_us"] = 1000 * config.node_heartbeat_period_ms
        to["node_timeout_us"] = 1000 * config.node_heartbeat_timeout_ms

    # -- how it fares -----------------------------------------------------------------------------------------------

    @property
    def state(self) -> DriverState:
        """Where the connection is."""
        return _STATES[int(self.memory["state"][0])]

    @property
    def node_events(self) -> int:
        """NODE_... bits."""
        return int(self.memory["node_events"][0])

    @property
    def node_state(self) -> int | None:
        """As the node's last heartbeat said; None if there was none."""
        said = int(self.memory["node_state"][0])
        return said if said >= 0 else None

    @property
    def failure(self) -> str:
        """The first cause; empty if there is none."""
        m, config = self.memory[0], self.config
        name = f"amplifier (node {config.node_id})"
        match Failure(int(m["failure"])):
            case Failure.NONE:
                return ""
            case Failure.HEARTBEAT_LOST:
                silent_ms = (int(m["silent_us"]) + 1000 * config.node_heartbeat_timeout_ms) / 1000
                return (
                    f"{name} sent no heartbeat for {silent_ms:g} ms, expected one every "
                    f"{config.node_heartbeat_period_ms} ms; check cable and power, then start it again"
                )
            case Failure.NOT_OPERATIONAL:
                return (
                    f"{name} left the operational state: its heartbeat says {state_name(int(m['failed_state']))}; look "
                    "at its emergencies, then start it again"
                )
            case Failure.REBOOTED:
                return (
                    f"{name} restarted by itself (boot-up message while operational); check its power supply, then "
                    "start it again"
                )
        return failure_words(config, self._settings, m["start"][0], int(m["failed_state"]), self.foreign)

    @property
    def lost(self) -> tuple[str, ...]:
        """Protections that this node does not give, and what stands in for them."""
        memory = self.memory["start"][0, 0]
        if not memory["is_surveyed"]:
            return ()
        missed = (f"{never_booted(self.config)}: that it answers, and what it holds, was seen instead",)
        told = lost(self.config, self._settings, self.record["start"][0, 0], memory)
        return (*missed, *told) if memory["never_booted"] else told

    @property
    def foreign(self) -> str:
        """The first frame that only we may send, and did not; empty if none came."""
        can_id, length = int(self.memory["foreign_id"][0]), int(self.memory["foreign_length"][0])
        if can_id < 0:
            return ""
        data = bytes_of(int(self.memory["foreign_data"][0]), min(length, HEAD)).hex(" ")
        return (
            f"0x{can_id:03X} [{data}{' ...' if length > HEAD else ''}], {self._ours[can_id]} that this controller did "
            "not send: look for a second controller, a master or a tool on the bus, or receive_own_messages in its "
            "options"
        )

    # -- start and stop ---------------------------------------------------------------------------------------------

    def start(self, t_us: int) -> Frames:
        """Resets the node and begins the start-up dialogue, from any state; counters, events and failure start anew."""
        self.emergencies.clear()
        self._start(self.record, self.memory, t_us)
        return self._sent()

    def poll(self, t_us: int) -> Frames:
        """Time-outs and repetitions of the start-up dialogue; our heartbeat while no loop sends it.

        To be called at least every few milliseconds until OPERATIONAL. The loop needs it no longer: ``sync``
        supervises the node, and ``heartbeat_due`` lets the loop choose the place of the heartbeat.
        """
        self._poll(self.record, self.memory, t_us)
        return self._sent()

    def stop(self, t_us: int) -> Frames:
        """0 V, then NMT pre-operational, where the node's outputs take their error value (0 V). State OFF."""
        driver_rules.stop(self.record, self.memory)
        return self._sent()

    def release(self, t_us: int) -> Frames:
        """What takes the node out of operational, where its outputs are at 0 V without any SYNC: to be sent again and
        again while nobody may want a voltage, until a heartbeat of the node's own says that it has left (RELEASED).

        Until then ours is not sent, so that a node that can't be told goes to 0 V by its consumer, too; from then on it
        comes from here, since a tick without a sense frame ends too late for it. ``start`` begins anew.
        """
        driver_rules.release(self.record, self.memory, t_us)
        return self._sent()

    def acknowledge(self) -> None:
        """Takes note of the emergencies: clears NODE_EMERGENCY, keeps the list."""
        self.memory["node_events"] &= ~NODE_EMERGENCY

    # -- the loop ---------------------------------------------------------------------------------------------------

    def sync(self, t_us: int) -> Frame:
        """The SYNC that begins a tick; its counter runs 1..240. What was received before is old from now on."""
        self._sync(self.record, self.memory, t_us)
        return self._sent()[0]

    def receive(self, frame: Frame, t_us: int) -> Frames:
        """Takes any frame from the bus and returns what is to be sent at once (SDO requests during the start)."""
        can_id, data, flags = frame
        told = self._receive(self.record, self.memory, can_id, flags, len(data), word_of(data), t_us)
        self.told(frame, told, t_us)
        return self._sent() if told & driver_rules.START_UP else _NOTHING

    def told(self, frame: Frame, told: int, t_us: int) -> None:
        """Keeps an emergency, if ``told``, of ``driver_rules.receive``, says that ``frame`` is one."""
        if told & driver_rules.EMERGENCY:
            emergency = decode_emergency(frame.data, t_us)
            assert emergency is not None
            self.emergencies.append(emergency)

    def drive(self, counts: Counts, t_us: int) -> Frame:
        """The drive PDO, 0..32767 counts for 0..200 V. It is applied at the end of the next SYNC.

        Raises CountsOutOfRangeError beyond INTEGER16; the alive counter then stays.
        """
        self._drive_codec.require(counts)
        self._drive(self.record, self.memory, *counts)
        return self._sent()[0]

    def revoke_drive(self) -> None:
        """The last drive PDO was not sent after all: its alive counter is the next one's."""
        driver_rules.revoke_drive(self.memory)

    def heartbeat_due(self, t_us: int) -> Frame | None:
        """Our heartbeat if its time has come; whoever sends it says so with ``heartbeat_sent``."""
        if t_us < self.memory["heartbeat_next_us"][0]:
            return None
        return Frame._make((int(self.record["our_heartbeat_id"][0]), b"\x05", self._flags))

    def heartbeat_sent(self, t_us: int) -> None:
        """The next one is due a period after this one was due; periods that were missed are skipped whole."""
        driver_rules.heartbeat_sent(self.record, self.memory, t_us)

    def _sent(self) -> Frames:
        """Take what the rules want to send."""
        m = self.memory[0]
        count, m["outgoing"] = int(m["outgoing"]), 0
        return tuple(
            Frame._make((int(out["can_id"]), bytes_of(int(out["data"]), int(out["length"])), int(out["flags"])))
            for out in m["out"][:count]
        )
