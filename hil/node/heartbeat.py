"""Heartbeats of the amplifier node, both ways (CiA 301, 7.2.8.3.2)."""

from collections.abc import Callable

from hil.node.alarm import Alarm, Scheduler


class HeartbeatProducer:
    """Sends a heartbeat at least every period: behind a sense PDO where there is one in time, else by itself."""

    def __init__(self, clock: Scheduler, send: Callable[[], None]) -> None:
        self.alarm = Alarm(clock, self._beat)
        self._clock = clock
        self._send = send
        self.beat_period_us = 0

    def configure(self, period_us: int, *, beat_now: bool) -> None:
        """New period, 0 = off. It holds at once: the first heartbeat goes out now unless a boot-up has just gone."""
        self.beat_period_us = period_us
        self.alarm.cancel()
        if period_us and beat_now:
            self._beat(self._clock.now_us)
        elif period_us:
            self.alarm.set(self._clock.now_us + period_us)

    def ride(self, now_us: int, cycle_us: int) -> bool:
        """A sense PDO has just been queued: go along if the next one, ``cycle_us`` from now, would be too late. Whether
        it does.
        """
        due_us = self.alarm.due_us
        if due_us is None or now_us + cycle_us < due_us:
            return False
        self._beat(now_us)
        return True

    def _beat(self, now_us: int) -> None:
        self._send()
        self.alarm.set(now_us + self.beat_period_us)


class HeartbeatConsumer:
    """Watches one node. Starts with its first heartbeat; then ``lost`` is called exactly when the time is over."""

    def __init__(self, clock: Scheduler, lost: Callable[[int], None], found: Callable[[], None]) -> None:
        self.alarm = Alarm(clock, self._time_out)
        self._lost = lost
        self._found = found
        self.time_us = 0
        self._is_lost = False
        self.cob_id: int | None = None

    def configure(self, entry: int) -> None:
        """``entry`` as in object 0x1016: node id in bits 16 to 23, time in ms in bits 0 to 15; either 0 = off."""
        self.alarm.cancel()
        node_id, self.time_us = entry >> 16 & 0x7F, (entry & 0xFFFF) * 1000
        self.cob_id = 0x700 + node_id if node_id and self.time_us else None
        if self._is_lost:
            self._is_lost = False
            self._found()

    def receive(self, data: bytes, t_us: int) -> None:
        if len(data) != 1:
            return
        if data[0] == 0:  # boot-up: whoever was in charge is so no longer
            if self.alarm.due_us is not None:
                self.alarm.cancel()
                self._time_out(t_us)
            return
        self.alarm.set(t_us + self.time_us)
        if self._is_lost:
            self._is_lost = False
            self._found()

    def _time_out(self, now_us: int) -> None:
        self._is_lost = True
        self._lost(now_us)
