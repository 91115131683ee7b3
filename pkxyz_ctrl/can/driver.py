"""The controller's side of the connection to the amplifier: frames in, frames out, time passed in.

No clock, no socket, no thread. The start-up dialogue is driven by ``start``, ``receive`` and ``poll``; once
``state`` is OPERATIONAL the loop calls ``sync``, ``receive``, ``sense.take``, ``drive`` and ``heartbeat_due``.
"""

from collections import deque

from . import cob_id
from .cob_id import NmtCommand, NmtState
from .codec import Counts, ProcessCodec
from .driver_config import DriverConfig
from .emergency import Emergency, decode_emergency
from .frame import FD_FAST, UNUSUAL, Frame
from .sense_input import SenseInput
from .start_sequence import DriverState, Messages, StartSequence, state_name

NODE_HEARTBEAT_LOST = 1
NODE_NOT_OPERATIONAL = 2
NODE_REBOOTED = 4
NODE_EMERGENCY = 8
FOREIGN_FRAME = 16

Frames = tuple[Frame, ...]

_NOTHING: Frames = ()
_NEVER_US = 1 << 62
_HEARTBEATS_APART_US = 1000  # some ticks; where a tick is longer, both fit into it
_EMERGENCIES_KEPT = 64
_STARTING_UP = frozenset(
    (
        DriverState.RESETTING,
        DriverState.IDENTIFYING,
        DriverState.CONFIGURING,
        DriverState.STARTING,
        DriverState.TRYING,
    )
)
_SPOKEN_FOR = _STARTING_UP - {DriverState.RESETTING, DriverState.IDENTIFYING} | {DriverState.OPERATIONAL}
_TRIAL = (DriverState.TRYING, DriverState.STARTING)
_HEARTBEAT_ERROR = 0x8130  # EMCY: what the node has to say in the trial
_new_tuple = tuple.__new__  # a Frame without its keyword defaults: 0.2 us less in every tick


class AmplifierDriver:
    """Starts, feeds and watches one amplifier node (CiA 301 master services that it needs, CiA 401 PDOs).

    ``state`` and ``failure`` (a sentence: what was expected, what came, what to do) tell how the connection fares.
    ``node_events`` (NODE_... bits) are latched: EMERGENCY until ``acknowledge``, the others until ``start``, because a
    node that was silent, left the operational state or restarted has to be configured again, and so has one to which
    somebody else spoke in our name (FOREIGN_FRAME; ``foreign`` tells the first such frame). ``emergencies`` holds
    the last 64. ``lost`` tells which protections this node does not give, and what stands in for them. ``sense`` holds
    this tick's sense values. ``count_step_max``: the node's own limit of a step at a SYNC, in drive counts. All times
    are integer microseconds of the caller's one clock and never run backwards.
    """

    def __init__(
        self, config: DriverConfig, count_step_max: int = 32767, start_up: StartSequence | None = None
    ) -> None:
        """``start_up`` in place of the one that follows from the others."""
        self.config = config
        self._start_up = start_up or StartSequence(config, count_step_max)
        self.state = DriverState.OFF
        self.failure = ""
        self.node_events = 0
        self.node_state: int | None = None  # as its last heartbeat said
        self.foreign = ""
        self.lost: tuple[str, ...] = ()
        self.emergencies: deque[Emergency] = deque(maxlen=_EMERGENCIES_KEPT)
        self._sense_id = cob_id.sense(config.node_id, config.sense_pdo)
        self.drive_id = self._drive_id = cob_id.drive(config.node_id, config.drive_pdo)
        self._sdo_response_id = cob_id.SDO_RESPONSE_BASE + config.node_id
        self._emergency_id = cob_id.EMCY_BASE + config.node_id
        self._node_heartbeat_id = cob_id.HEARTBEAT_BASE + config.node_id
        self.sense = SenseInput(ProcessCodec(self._sense_id, config.protection))
        self._receive_sense = self.sense.receive
        self._encode_drive = ProcessCodec(self._drive_id, config.protection).encode
        self._ours = {
            cob_id.NMT: "an NMT command",
            cob_id.SYNC: "a SYNC",
            self._drive_id: "a drive PDO",
            cob_id.SDO_REQUEST_BASE + config.node_id: "an SDO request",
            cob_id.HEARTBEAT_BASE + config.controller_node_id: "a controller's heartbeat",
        }
        self._flags = FD_FAST if config.fd else 0
        self._sync_frames: Frames = (self._frame(cob_id.SYNC, b""),)
        self._sync_index = 0
        self._count_syncs_to(cob_id.SYNC_COUNTER_OVERFLOW)
        self._heartbeat_frame = self._frame(
            cob_id.HEARTBEAT_BASE + config.controller_node_id, bytes((NmtState.OPERATIONAL,))
        )
        self._heartbeat_period_us = 1000 * config.controller_heartbeat_period_ms
        self._node_timeout_us = 1000 * config.node_heartbeat_timeout_ms
        self._node_period_us = 1000 * config.node_heartbeat_period_ms
        self._node_heartbeat_us = 0  # the last
        self._node_deadline_us = _NEVER_US
        self._heartbeat_next_us = _NEVER_US
        self._drive_counter = 0

    # -- start and stop ---------------------------------------------------------------------------------------------

    def start(self, t_us: int) -> Frames:
        """Resets the node and begins the start-up dialogue, from any state; counters, events and failure start anew."""
        self.failure = ""
        self.node_events = 0
        self.node_state = None
        self.foreign = ""
        self.emergencies.clear()
        self.sense.reset()
        self._sync_index = 0
        self._drive_counter = 0
        self._node_deadline_us = _NEVER_US
        self._heartbeat_next_us = _NEVER_US
        return self._go_on(self._start_up.begin(t_us), t_us)

    def poll(self, t_us: int) -> Frames:
        """Time-outs and repetitions of the start-up dialogue; our heartbeat while no loop sends it.

        To be called at least every few milliseconds until OPERATIONAL. The loop needs it no longer: ``sync``
        supervises the node, and ``heartbeat_due`` lets the loop choose the place of the heartbeat.
        """
        frames = _NOTHING
        if self.state in _STARTING_UP:
            frames = self._go_on(self._start_up.poll(t_us), t_us)
        if t_us > self._node_deadline_us:
            self._node_lost(t_us)
        heartbeat = self.heartbeat_due(t_us)
        if heartbeat is not None:
            self.heartbeat_sent(t_us)
            frames = (*frames, heartbeat)
        return frames

    def stop(self, t_us: int) -> Frames:
        """0 V, then NMT pre-operational, where the node's outputs take their error value (0 V). State OFF."""
        self._fall_silent()
        self.state = DriverState.OFF
        return self.drive((0, 0, 0), t_us), self._nmt(NmtCommand.PRE_OPERATIONAL)

    def release(self, t_us: int) -> Frames:
        """What takes the node out of operational, where its outputs are at 0 V without any SYNC: to be sent again and
        again while nobody may want a voltage, until a heartbeat of the node's own says that it has left (RELEASED).

        Until then ours is not sent, so that a node that can't be told goes to 0 V by its consumer, too; from then on it
        comes from here, since a tick without a sense frame ends too late for it. ``start`` begins anew.
        """
        if self.state is DriverState.RELEASED:
            heartbeat = self.heartbeat_due(t_us)
            if heartbeat is None:
                return _NOTHING
            self.heartbeat_sent(t_us)
            return (heartbeat,)
        self._fall_silent()
        self.state = DriverState.RELEASING
        return (self._nmt(NmtCommand.PRE_OPERATIONAL),)

    def acknowledge(self) -> None:
        """Takes note of the emergencies: clears NODE_EMERGENCY, keeps the list."""
        self.node_events &= ~NODE_EMERGENCY

    # -- the loop ---------------------------------------------------------------------------------------------------

    def sync(self, t_us: int) -> Frame:
        """The SYNC that begins a tick; its counter runs 1..240. What was received before is old from now on."""
        if t_us > self._node_deadline_us:
            self._node_lost(t_us)
        self.sense.on_sync()
        index = self._sync_index
        frames = self._sync_frames
        self._sync_index = index + 1 if index < len(frames) - 1 else 0
        return frames[index]

    def receive(self, frame: Frame, t_us: int) -> Frames:
        """Takes any frame from the bus and returns what is to be sent at once (SDO requests during the start)."""
        received_id, data, flags = frame
        if flags & UNUSUAL:
            return _NOTHING
        if received_id == self._sense_id:
            self._receive_sense(data)
        elif received_id == self._node_heartbeat_id:
            return self._on_heartbeat(data, t_us)
        elif received_id == self._sdo_response_id:
            return self._go_on(self._start_up.answer(data, t_us), t_us) if self.state in _STARTING_UP else _NOTHING
        elif received_id == self._emergency_id:
            self._on_emergency(data, t_us)
        elif received_id in self._ours:
            return self._on_foreign(received_id, data, t_us)
        return _NOTHING

    def drive(self, counts: Counts, t_us: int) -> Frame:
        """The drive PDO, 0..32767 counts for 0..200 V. It is applied at the end of the next SYNC.

        Raises CountsOutOfRangeError beyond INTEGER16; the alive counter then stays.
        """
        counter = self._drive_counter
        data = self._encode_drive(counts, counter)
        self._drive_counter = (counter + 1) & 0xFF
        return _new_tuple(Frame, (self._drive_id, data, self._flags))

    def revoke_drive(self) -> None:
        """The last drive PDO was not sent after all: its alive counter is the next one's."""
        self._drive_counter = (self._drive_counter - 1) & 0xFF

    def heartbeat_due(self, t_us: int) -> Frame | None:
        """Our heartbeat if its time has come; whoever sends it says so with ``heartbeat_sent``."""
        return self._heartbeat_frame if t_us >= self._heartbeat_next_us else None

    def heartbeat_sent(self, t_us: int) -> None:
        """The next one is due a period after this one was due; periods that were missed are skipped whole."""
        if t_us >= self._heartbeat_next_us:
            missed = (t_us - self._heartbeat_next_us) // self._heartbeat_period_us
            self._heartbeat_next_us += (missed + 1) * self._heartbeat_period_us
            self._keep_away(t_us)

    # -- what the node says -----------------------------------------------------------------------------------------

    def _on_heartbeat(self, data: bytes, t_us: int) -> Frames:
        if len(data) != 1:
            return _NOTHING
        node_state = data[0] & 0x7F  # bit 7 is the toggle bit of node guarding
        self.node_state = node_state
        if self.state in (DriverState.RELEASING, DriverState.RELEASED):
            self._on_heartbeat_after_release(node_state, t_us)
            return _NOTHING
        frames = _NOTHING
        if self.state in _STARTING_UP:
            frames = self._go_on(self._start_up.heartbeat(node_state, t_us), t_us)
        elif node_state == NmtState.BOOT_UP:
            self._on_boot_up()
        if self.state is DriverState.OPERATIONAL:
            self._node_deadline_us = t_us + self._node_timeout_us
            self._node_heartbeat_us = t_us
            self._keep_away(t_us)
            if node_state != NmtState.OPERATIONAL:
                self.node_events |= NODE_NOT_OPERATIONAL
                self._fail(
                    f"amplifier (node {self.config.node_id}) left the operational state: its heartbeat says "
                    f"{state_name(node_state)}; look at its emergencies, then start it again"
                )
        return frames

    def _on_heartbeat_after_release(self, node_state: int, t_us: int) -> None:
        if node_state == NmtState.OPERATIONAL:  # not yet, or somebody has started it again
            self._fall_silent()
            self.state = DriverState.RELEASING
        elif self.state is DriverState.RELEASING:
            self.state = DriverState.RELEASED
            self._heartbeat_next_us = t_us

    def _keep_away(self, t_us: int) -> None:
        """A tick has room for one heartbeat: where ours would meet one of the node's, it goes out a little earlier, but
        not now, where the node's has just come.
        """
        if self.state is DriverState.OPERATIONAL:
            after_us = (self._heartbeat_next_us - self._node_heartbeat_us + _HEARTBEATS_APART_US) % self._node_period_us
            is_near = after_us < 2 * _HEARTBEATS_APART_US < self._node_period_us
            if is_near and self._heartbeat_next_us - after_us > t_us:
                self._heartbeat_next_us -= after_us

    def _on_boot_up(self) -> None:
        if self.state in (DriverState.OPERATIONAL, DriverState.FAILED):
            self.node_events |= NODE_REBOOTED | NODE_NOT_OPERATIONAL
            self._fail(
                f"amplifier (node {self.config.node_id}) restarted by itself (boot-up message while operational); "
                "check its power supply, then start it again"
            )

    def _on_emergency(self, data: bytes, t_us: int) -> None:
        emergency = decode_emergency(data, t_us)
        if emergency is None:
            return
        if self.state in _TRIAL and (emergency.code == _HEARTBEAT_ERROR or emergency.is_reset):
            return  # as it should be
        self.emergencies.append(emergency)
        if not emergency.is_reset:
            self.node_events |= NODE_EMERGENCY

    def _on_foreign(self, received_id: int, data: bytes, t_us: int) -> Frames:
        """A frame that only we may send, and that we did not, since a controller does not receive its own.

        What comes before the node is configured, a predecessor's last heartbeat perhaps, the configuration undoes; what
        comes while the node is tried, and we are silent, ends the start.
        """
        if self.state not in _SPOKEN_FOR:
            return _NOTHING
        if received_id == cob_id.NMT and data[1:] not in (b"\0", bytes((self.config.node_id,))):
            return _NOTHING  # to another node
        self.node_events |= FOREIGN_FRAME
        self.foreign = self.foreign or (
            f"0x{received_id:03X} [{data.hex(' ')}], {self._ours[received_id]} that this controller did not send: "
            "look for a second controller, a master or a tool on the bus, or receive_own_messages in its options"
        )
        return self._go_on(self._start_up.disturbed(self.foreign), t_us) if self.state in _TRIAL else _NOTHING

    def _node_lost(self, t_us: int) -> None:
        silent_ms = (t_us - self._node_deadline_us + self._node_timeout_us) / 1000
        self.node_events |= NODE_HEARTBEAT_LOST
        self._fail(
            f"amplifier (node {self.config.node_id}) sent no heartbeat for {silent_ms:g} ms, expected one every "
            f"{self.config.node_heartbeat_period_ms} ms; check cable and power, then start it again"
        )

    def _go_on(self, messages: Messages, t_us: int) -> Frames:
        """Send what the start-up says, and take over where it stands: our heartbeat runs while the node is starting,
        and stays away while its loss is tried.
        """
        start_up, was = self._start_up, self.state
        self.state = state = start_up.state
        self.lost = start_up.lost
        if state is not was:
            self._fall_silent()
            if state is DriverState.STARTING:
                self._heartbeat_next_us = t_us + self._heartbeat_period_us
                self._count_syncs_to(start_up.sync_overflow)
            elif state is DriverState.OPERATIONAL:  # the loop's first tick has the node's heartbeat in it
                self._heartbeat_next_us = t_us + 2 * _HEARTBEATS_APART_US
            elif state is DriverState.FAILED:
                self._fail(start_up.failure)
        return tuple(self._frame(*message) for message in messages)

    # -- small things -----------------------------------------------------------------------------------------------

    def _fail(self, failure: str) -> None:
        self.failure = self.failure or failure  # the first cause counts
        self._fall_silent()
        self.state = DriverState.FAILED

    def _fall_silent(self) -> None:
        self._node_deadline_us = _NEVER_US
        self._heartbeat_next_us = _NEVER_US

    def _frame(self, frame_id: int, data: bytes) -> Frame:
        return Frame._make((frame_id, data, self._flags))

    def _nmt(self, command: NmtCommand) -> Frame:
        return self._frame(cob_id.NMT, bytes((command, self.config.node_id)))

    def _count_syncs_to(self, overflow: int) -> None:
        """SYNC counters run from 1 to ``overflow``; 0: a SYNC has none."""
        if len(self._sync_frames) != max(1, overflow) or bool(self._sync_frames[0].data) != (overflow > 0):
            counters = [bytes((count,)) for count in range(1, overflow + 1)] or [b""]
            self._sync_frames = tuple(self._frame(cob_id.SYNC, counter) for counter in counters)
            self._sync_index = 0
