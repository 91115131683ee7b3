"""Time that stands still where a process is late: for a loop and an amplifier simulated beside it, on a computer that
does something else for some milliseconds now and then.

The loop owns the time. It lets none pass while it is late for a tick (``io.clocks``), nor while the answer to a SYNC
is (``WaitingPort``; ``loop.c`` does both likewise). To the amplifier each SYNC is a period after the one before,
whenever it comes, and what is due later than that period waits for the next (``AmplifierTime``). So both see what they
would see on a computer that is never late. Whoever is silent for longer is gone, and time goes on without.
"""

from typing import TYPE_CHECKING

from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.io.clocks import WallClock

if TYPE_CHECKING:
    from pkxyz_ctrl.loop.runtime import Port

STANDSTILL_US = 100_000
"""For so long at once the time of an amplifier that is only simulated waits for the computer, where nobody says."""
_STANDS_US = 100
"""Before the deadline of an answer time stands for so long, again and again, until it comes."""


def waiting(bus: BusConfig) -> BusConfig:
    """A bus between processes, in a time that waits."""
    assert bus.can is not None
    return bus.model_copy(update={"can": bus.can.model_copy(update={"standstill_max_us": STANDSTILL_US})})


class WaitingPort:
    """The loop's port of ``bus`` once it runs: an answer to a SYNC that is late holds up the time.

    An amplifier that did not answer the last time is not waited for.
    """

    def __init__(self, port: "Port", clock: WallClock, bus: BusConfig) -> None:
        assert bus.can is not None
        driver = bus.can.driver
        self._port, self._clock = port, clock
        self._stands_most_us = bus.can.standstill_max_us
        self._sense_id = cob_id.sense(driver.node_id, driver.sense_pdo)
        self._has_answered = True
        self._deadline_us = self._stood_us = 0
        self.send, self.unsent = port.send, port.unsent

    def receive(self, deadline_us: int) -> Frame | None:
        """The next frame; None once it is ``deadline_us`` and no answer that was to come then has come later. With
        0 only what is there already.
        """
        if deadline_us != self._deadline_us:
            self._deadline_us, self._stood_us = deadline_us, 0
        while True:
            frame = self._port.receive(deadline_us)
            if frame is not None and frame.can_id == self._sense_id:
                self._has_answered = True
                return frame
            if not self._has_answered or deadline_us == 0 or (frame is not None and self._clock.now_us <= deadline_us):
                return frame
            if self._stood_us >= self._stands_most_us:
                self._has_answered = False
                return frame
            self._clock.stand_at(deadline_us - _STANDS_US)
            self._stood_us += _STANDS_US
            if frame is not None:
                return frame


class AmplifierTime:
    """The amplifier's time, by the machine's: the same, but where a loop that may stand still gives the pace.

    While SYNCs come, less than twice ``standstill_max_us`` apart, each begins a period of ``period_us``, and time ends
    with that until the next.
    """

    def __init__(self, period_us: int, standstill_max_us: int) -> None:
        self._period_us, self._silence_us = period_us, 2 * standstill_max_us
        self._behind_us = 0  # the machine's clock
        self._ends_us = 0  # last of the period, by the amplifier's time
        self._until_us = 0  # when the pace is given up, by the machine's

    def sync(self, stamp_us: int, wall_us: int) -> None:
        """A SYNC that was sent at ``stamp_us`` has come at ``wall_us``, both by the machine's clock."""
        if self._silence_us:
            begin_us = self._ends_us + 1 if wall_us < self._until_us else stamp_us - self._behind_us
            self._behind_us = stamp_us - begin_us
            self._ends_us = begin_us + self._period_us - 1
            self._until_us = wall_us + self._silence_us

    def time_us(self, wall_us: int) -> int:
        """The amplifier's time when the machine's clock says ``wall_us``."""
        time_us = wall_us - self._behind_us
        return min(time_us, self._ends_us) if wall_us < self._until_us else time_us

    def wall_us(self, time_us: int) -> int:
        """What the machine's clock says at ``time_us``; where time has to go on first, when it would without a loop."""
        wall_us = time_us + self._behind_us
        return max(wall_us, self._until_us) if time_us > self._ends_us else wall_us
