"""A node at work as records, for ``rules``: taken from the node, and put back into it."""

import numpy as np

from hil.node.amplifier import AmplifierNode, NmtState
from hil.node.object_dictionary import Value
from hil.node.objects import LOOKED_UP
from hil.node.rules import NEVER_US, NODE, NODE_MEMORY, OBJECTS_MOST, UNKNOWN, crc_start
from hil.node.sdo_server import SdoServer
from hil.node.signature import SIGNED, signature

_WATCHED_MOST = 1
_SHORT, _SHORT_REPLY = 0xE2, 0x42  # of a reply's command: a value of four bytes at most


class NodeAtWork:
    """``record`` (1,) of ``NODE`` and ``memory`` (1,) of ``NODE_MEMORY``, valid between `take` and `put`."""

    def __init__(self, node: AmplifierNode) -> None:
        self.node = node
        self.record, self.memory = np.zeros(1, NODE), np.zeros(1, NODE_MEMORY)
        self._entries = [e for e in node.od if e.index not in LOOKED_UP][:OBJECTS_MOST]
        self._seen: list[Value | None] = [None] * len(self._entries)  # the values that ``record`` answers with
        self.record["objects_count"] = len(self._entries)
        self.record["request_id"], self.record["reply_id"] = 0x600 + node.node_id, 0x580 + node.node_id
        self.record["heartbeat_id"], self.record["flags"] = 0x700 + node.node_id, node._flags
        self._settings: tuple[int, ...] = ()  # those that ``record`` holds
        self._signed = [e for e in node.od if e.index in SIGNED]
        self._signed_values: list[Value | None] = []  # those of which ``record`` holds the signature

    def take(self) -> bool:
        """Read the node. False for one that does anything else than its daily work."""
        node, m = self.node, self.memory[0]
        drive, sense = node._drive, node._sense
        watched = [consumer for consumer in node._consumers if consumer.cob_id is not None]
        if (
            node.state is not NmtState.OPERATIONAL
            or node._holds
            or node._sync_expected is None
            or not drive.is_usual
            or not sense.is_usual
            or not node.digital.is_usual
            or len(watched) > _WATCHED_MOST
            or node.emergency.is_waiting
        ):
            return False
        self._take_settings()
        self._take_signature()
        errors = [e.quiet_from_us for e in (node._sync_errors, node._drive_errors) if e.present]
        m["good_us"] = min(errors, default=NEVER_US)
        m["drive_deadline_us"], m["beat_us"] = _time(node._drive_deadline.due_us), _time(node._heartbeat.alarm.due_us)
        m["consumer_us"] = _time(watched[0].alarm.due_us) if watched else NEVER_US
        m["sync_us"], m["cycle_us"], m["due_us"] = sense.sync_us, sense.cycle_us, _time(sense.due_us)
        m["output"], m["is_pending"] = node.outputs, drive.pending is not None
        m["pending"] = drive.pending or 0
        m["drive_counter"], m["drive_crc"] = drive.counter, drive.crc
        m["sync_expected"] = node._sync_expected[0] if node._sync_expected else 0
        m["count"], m["sense_counter"], m["sense_crc"] = sense.counts, sense.counter, sense.crc
        m["digital"] = node.digital.bits
        m["signature_left"], m["signature_waits"] = node.signature.left, node.signature.is_waiting
        m["digital_pending"] = -1 if node.digital.pending is None else node.digital.pending
        return True

    def _take_settings(self) -> None:
        """What it goes by, which seldom changes: to write a record takes longer than to look."""
        node = self.node
        watched = [(consumer.cob_id, consumer.time_us) for consumer in node._consumers if consumer.cob_id is not None]
        settings = (
            node.od[0x1005, 0] & 0x7FF, node._drive_pdo.cob_id, node._sense_pdo.cob_id,
            next(iter(node.digital.receivers), -1), *(watched[-1] if watched else (-1, 0)),
            node._drive._limit, node._step_max, 0 if b"" in node._sync_following else len(node._sync_following),
            node._sense.turnaround_us, node._drive_timeout_us, node._heartbeat.beat_period_us,
            node.signature.cob_id, node.signature.every,
        )  # fmt: skip
        if settings == self._settings:
            return
        self._settings, c = settings, self.record[0]
        (
            c["sync_id"], c["drive_id"], c["sense_id"],
            c["output_id"], c["consumer_id"], c["consumer_time_us"],
            c["limit"], c["step_max"], c["sync_overflow"],
            c["turnaround_us"], c["drive_timeout_us"], c["beat_period_us"],
            c["signature_id"], c["signature_every"],
        ) = settings  # fmt: skip
        c["drive_crc_start"], c["sense_crc_start"] = crc_start(int(c["drive_id"])), crc_start(int(c["sense_id"]))

    def _take_signature(self) -> None:
        """To sign takes longer than to see that nothing has changed."""
        values: list[Value | None] = [entry.value for entry in self._signed]
        if values != self._signed_values:
            self._signed_values = values
            self.record["signature"] = signature(self.node.od)

    def put(self) -> None:
        """What has become of the node's state; `take` had said yes."""
        node, m = self.node, self.memory[0]
        drive, sense = node._drive, node._sense
        node._drive_deadline.due_us, node._heartbeat.alarm.due_us = _due(m["drive_deadline_us"]), _due(m["beat_us"])
        for consumer in node._consumers:
            if consumer.cob_id is not None:
                consumer.alarm.due_us = _due(m["consumer_us"])
        sense.sync_us, sense.cycle_us = int(m["sync_us"]), int(m["cycle_us"])
        a, b, c = m["output"].tolist()
        node.outputs = a, b, c
        node._silent_syncs = 0
        node._sync_expected = bytes((int(m["sync_expected"]),)) if self.record["sync_overflow"][0] else b""
        a, b, c = m["pending"].tolist()
        drive.pending = (a, b, c) if m["is_pending"] else None
        drive.counter, drive.crc = int(m["drive_counter"]), int(m["drive_crc"])
        a, b, c = m["count"].tolist()
        sense.counts = sense._sent = a, b, c
        sense.counter, sense.crc = int(m["sense_counter"]), int(m["sense_crc"])
        digital = int(m["digital_pending"])
        node.signature.left, node.signature.is_waiting = int(m["signature_left"]), bool(m["signature_waits"])
        node.digital.bits = node.od[0x6200, 1] = int(m["digital"])
        node.digital.pending = None if digital < 0 else digital

    def take_at_rest(self) -> int | None:
        """Read a node that is not operational: its state, as its heartbeat has it. None for one that is, or that
        watches more than the controller.
        """
        node, m = self.node, self.memory[0]
        watched = [consumer for consumer in node._consumers if consumer.cob_id is not None]
        is_booting, is_ready = node.state is NmtState.INITIALISING, node.state is NmtState.PRE_OPERATIONAL
        is_stopped = node.state is NmtState.STOPPED
        if not (is_booting or is_ready or is_stopped) or len(watched) > _WATCHED_MOST:
            return None
        self._take_settings()
        self._take_objects()
        m["drive_deadline_us"] = m["due_us"] = m["beat_us"] = m["consumer_us"] = NEVER_US
        m["served_key"] = -1
        if not is_booting:
            beat_us = node._heartbeat.alarm.due_us
            m["beat_us"] = NEVER_US if beat_us is None else beat_us
            lasts_us = watched[0].alarm.due_us if watched else None
            m["consumer_us"] = NEVER_US if lasts_us is None else lasts_us
            expected = node._sync_expected
            m["sync_expected"] = UNKNOWN if expected is None else expected[0] if expected else 0
        return int(node.state)

    def put_at_rest(self) -> None:
        """What has become of it; ``take_at_rest`` had not said None."""
        node, m = self.node, self.memory[0]
        if node.state is NmtState.INITIALISING:
            return
        if m["served_key"] >= 0:
            node._sdo.reset()
            node._sdo._multiplexer = int(m["served_key"]).to_bytes(3, "little")
        node._heartbeat.alarm.due_us = None if m["beat_us"] >= NEVER_US else int(m["beat_us"])
        for consumer in node._consumers:
            if consumer.cob_id is not None and m["consumer_us"] != NEVER_US:
                consumer.alarm.due_us = int(m["consumer_us"])
        if m["sync_expected"] != UNKNOWN:
            node._sync_expected = bytes((int(m["sync_expected"]),)) if self.record["sync_overflow"][0] else b""

    def _take_objects(self) -> None:
        """What its SDO server answers to who reads."""
        values: list[Value | None] = [entry.value for entry in self._entries]
        if values == self._seen:
            return
        server, rows = SdoServer(self.node._sdo._objects), self.record["objects"][0]
        for place, (entry, value) in enumerate(zip(self._entries, values, strict=True)):
            if value != self._seen[place]:
                key = entry.index | entry.subindex << 16
                reply = server.serve(b"\x40" + key.to_bytes(3, "little") + bytes(4)) or bytes(8)
                is_short = reply[0] & _SHORT == _SHORT_REPLY
                rows[place] = key, int.from_bytes(reply, "little", signed=True) if is_short else 0
        self._seen = values


def _time(due_us: int | None) -> int:
    return NEVER_US if due_us is None else due_us


def _due(time_us: np.int64) -> int | None:
    return None if time_us >= NEVER_US else int(time_us)
