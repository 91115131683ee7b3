"""Transmission of the sense PDO: sampled at the SYNC, sent after the response time."""

import struct
from collections.abc import Callable
from typing import Protocol

from hil.node.alarm import Alarm, Scheduler
from hil.node.crc import WORDS, crc8h2f, last_byte_table
from hil.node.drive import Outputs
from hil.node.heartbeat import HeartbeatProducer
from hil.node.object_dictionary import ObjectDictionary
from hil.node.pdo import PdoParameters
from hil.node.signature import SignatureTransmitter

_pack_protected = struct.Struct("<3hBB").pack
_INPUT = 0x6401
_PROTECTION = 0x2001


class Plant(Protocol):
    """What the amplifier is wired to: three drive combs, three sense combs."""

    def exchange(self, t_us: int, counts: Outputs | None, /, *, sample: bool) -> Outputs:
        """It is ``t_us``, never earlier than before. The converters take ``counts``, or keep what they have; then, if
        asked to, the sense combs are sampled. Returns the counts of the last sample.
        """


class SenseTransmitter:
    """Samples and sends as the transmission type says (CiA 301, table 72).

    0: at a SYNC, if a count has changed since the last frame. 1 to 240: at every n-th SYNC, counted from the start or
    from the SYNC whose counter is the SYNC start value. 254, 255: by the event timer (CiA 401 would add a change of the
    input, which its object 0x6423 switches off by default and which this device does not have).
    """

    def __init__(
        self,
        od: ObjectDictionary,
        parameters: PdoParameters,
        clock: Scheduler,
        plant: Plant,
        send: Callable[[int, bytes], None],
        heartbeat: HeartbeatProducer,
        signature: SignatureTransmitter,
        turnaround_us: int,
    ) -> None:
        self._od = od
        self._parameters = parameters
        self._clock = clock
        self._plant = plant
        self._send = send
        self._heartbeat = heartbeat
        self._signature = signature
        self._w0, self._w1, self._w2 = WORDS
        self.turnaround_us = turnaround_us
        self._event = Alarm(clock, self._on_event)
        self._running = False
        self._each = False  # SYNC is one to sample at
        self._sent: tuple[int, int, int] | None = None  # last counts that were
        self._waits_for: bytes | None = None  # a SYNC with this, before anything is sampled
        self.sync_us = 0
        self.cycle_us = 0  # between the last two SYNCs
        self.due_us: int | None = None  # of the frame that waits for the response time
        self.counts = (0, 0, 0)  # last sample
        self.counter = 0  # alive counter of the last frame
        self.crc = 0
        self.configure()

    def configure(self) -> None:
        """Take over COB-ID, mapping, transmission type and timers from the dictionary."""
        od, parameters = self._od, self._parameters
        self._cob_id = parameters.cob_id
        self._layout = parameters.layout()
        is_default = self._layout.fields == parameters.protected_fields
        self._w3 = last_byte_table(self._cob_id) if is_default else None
        kind = parameters.transmission_type
        self._on_change = kind == 0
        self._every = max(1, kind) if parameters.in_use and kind <= 240 else 0
        self._to_go = self._every
        start = od[parameters.communication, 6] if od[0x1019, 0] else 0
        self._start_data = bytes((start,)) if start else None
        inhibit_us = 100 * od[parameters.communication, 3]
        event_us = 1000 * od[parameters.communication, 5]
        self._event_us = max(event_us, inhibit_us) if event_us and parameters.in_use and kind >= 254 else 0
        self._event.cancel()
        if self._running:
            self.start()

    @property
    def is_usual(self) -> bool:
        """Whether it sends the shipped frame at every SYNC, and nothing at another time."""
        return self._each and self._w3 is not None and not self._on_change and not self._event_us

    def start(self) -> None:
        """The node has become operational."""
        self._running = True
        self._to_go = self._every
        self._sent = None
        self._waits_for = self._start_data
        self._each = self._every == 1 and self._start_data is None
        if self._event_us:
            self._event.set(self._clock.now_us + self._event_us)

    def stop(self) -> None:
        """The node has left operational: what waits for the response time is not sent."""
        self._running = False
        self.due_us = None
        self._event.cancel()

    def on_sync(self, data: bytes, t_us: int, outputs: Outputs | None) -> None:
        """The SYNC at ``t_us``: the converters take ``outputs``, if there are any, and the sense combs are sampled if
        it is time to. ``data`` of the SYNC: its counter, or nothing.
        """
        self.cycle_us = t_us - self.sync_us
        self.sync_us = t_us
        is_time = self._each or self._is_time(data)
        counts = self._plant.exchange(t_us, outputs, sample=is_time)
        if not is_time:
            return
        self.counts = counts
        if self._on_change and counts == self._sent:
            return
        self.due_us = due_us = t_us + self.turnaround_us
        self._clock.call_at(due_us, self._on_turnaround)

    def _is_time(self, data: bytes) -> bool:
        self._to_go -= 1
        if self._waits_for is not None:
            if data != self._waits_for:
                return False
            self._waits_for = None
            self._to_go = 0
        if self._to_go > 0 or not self._every:
            return False
        self._to_go = self._every
        return True

    def _on_turnaround(self) -> None:
        now_us = self._clock.now_us
        if self.due_us is None or now_us < self.due_us:
            return  # stopped meanwhile, or overtaken by a SYNC that came too soon
        self.due_us = None
        self._transmit()
        self._signature.ride(self._heartbeat.ride(now_us, self.cycle_us))

    def _on_event(self, now_us: int) -> None:
        self.counts = self._plant.exchange(now_us, None, sample=True)
        self._transmit()
        self._event.set(now_us + self._event_us)

    def _transmit(self) -> None:
        self.counter = counter = (self.counter + 1) & 0xFF
        w3 = self._w3
        if w3 is not None:
            a, b, c = self._sent = self.counts
            self.crc = crc = self._w0[a] ^ self._w1[b] ^ self._w2[c] ^ w3[counter]
            self._send(self._cob_id, _pack_protected(a, b, c, counter, crc))
        else:
            self._send(self._cob_id, self._encode_mapped())

    def _encode_mapped(self) -> bytes:
        self._sent = self.counts
        od, layout = self._od, self._layout
        self.publish()
        data = layout.codec.pack(*(od[field] for field in layout.fields))
        if layout.crc is not None:
            self.crc = od[_PROTECTION, 2] = crc8h2f(self._cob_id.to_bytes(2, "little") + data[:-1])
            data = data[:-1] + bytes((self.crc,))
        return data

    def publish(self) -> None:
        """Bring the process values to where SDO reads them."""
        for subindex in (1, 2, 3):
            self._od[_INPUT, subindex] = self.counts[subindex - 1]
        self._od[_PROTECTION, 1] = self.counter
        self._od[_PROTECTION, 2] = self.crc
