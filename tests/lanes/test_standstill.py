"""Time that waits for a late process: what the amplifier makes of SYNCs, and what the loop makes of answers."""

from hypothesis import given
from hypothesis import strategies as st

from hil.lanes.standstill import AmplifierTime, WaitingPort
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load

PERIOD_US, STANDS_US = 500, 20_000
SENSE, OTHER = Frame(0x28A, bytes(8)), Frame(0x70A, b"\x05")
gaps_us = st.lists(st.integers(0, 2 * STANDS_US - 1), min_size=1, max_size=40)


@given(gaps_us)
def test_syncs_are_a_period_apart_whenever_they_come(gaps):
    time, wall_us = AmplifierTime(PERIOD_US, STANDS_US), 1_000_000
    time.sync(wall_us, wall_us)
    begun_us = time.time_us(wall_us)
    for n, gap in enumerate(gaps, 1):
        wall_us += gap
        time.sync(wall_us, wall_us)
        assert time.time_us(wall_us) == begun_us + n * PERIOD_US


@given(gaps_us, st.integers(0, 2 * STANDS_US - 1), st.integers(0, 2 * STANDS_US - 1))
def test_between_them_time_goes_on_as_far_as_the_period_lasts(gaps, one_us, other_us):
    time, wall_us = AmplifierTime(PERIOD_US, STANDS_US), 0
    for gap in gaps:
        wall_us += gap
        time.sync(wall_us, wall_us)
    begun_us = time.time_us(wall_us)
    sooner_us, later_us = sorted((one_us, other_us))
    sooner, later = time.time_us(wall_us + sooner_us), time.time_us(wall_us + later_us)
    assert sooner == begun_us + min(sooner_us, PERIOD_US - 1)
    assert sooner <= later < begun_us + PERIOD_US


def test_what_is_due_within_the_period_rings_in_it_and_what_is_due_later_once_the_loop_is_silent():
    time = AmplifierTime(PERIOD_US, STANDS_US)
    time.sync(3000, 3010)
    assert time.wall_us(3499) == 3499
    assert time.wall_us(3500) == 3010 + 2 * STANDS_US
    silent_us = 3010 + 2 * STANDS_US
    assert time.time_us(silent_us - 1) == 3499
    assert time.time_us(silent_us) == silent_us  # and on from there
    assert time.wall_us(silent_us + 7) == silent_us + 7


def test_a_loop_that_begins_anew_is_followed_from_when_it_does():
    time = AmplifierTime(PERIOD_US, STANDS_US)
    for wall_us in (3000, 13_000):  # stood still for 9.5 ms
        time.sync(wall_us, wall_us)
    assert time.time_us(13_000) == 3500
    time.sync(100_000, 100_000)
    assert time.time_us(100_000) == 90_500


@given(gaps_us, st.integers(0, 10**6))
def test_where_nobody_waits_time_is_the_machine_s(gaps, after_us):
    time, wall_us = AmplifierTime(PERIOD_US, 0), 0
    for gap in gaps:
        wall_us += gap
        time.sync(wall_us, wall_us)
    assert time.time_us(wall_us + after_us) == wall_us + after_us == time.wall_us(wall_us + after_us)


class Late:
    """Clock and port in one: frames that come when the machine's clock says so, a time that the loop may hold."""

    def __init__(self, *frames: tuple[int, Frame]) -> None:
        self.machine_us, self.behind_us = 0, 0
        self._frames = list(frames)
        self.send = self.unsent = None

    @property
    def now_us(self) -> int:
        return self.machine_us - self.behind_us

    def stand_at(self, t_us: int) -> None:
        self.behind_us = max(self.behind_us, self.machine_us - t_us)

    def receive(self, deadline_us: int) -> Frame | None:
        if self._frames and self._frames[0][0] - self.behind_us <= max(deadline_us, self.now_us):
            came_us, frame = self._frames.pop(0)
            self.machine_us = max(self.machine_us, came_us)
            return frame
        self.machine_us = max(self.machine_us, deadline_us + self.behind_us)
        return None


def waiting(late: Late) -> WaitingPort:
    bus = load("buses", "unix_2k", BusConfig)
    assert bus.can is not None
    can = bus.can.model_copy(update={"standstill_max_us": STANDS_US})
    return WaitingPort(late, late, bus.model_copy(update={"can": can}))  # type: ignore[arg-type]


def test_an_answer_that_is_late_comes_in_time():
    late = Late((100, SENSE), (9000, SENSE))
    port = waiting(late)
    assert port.receive(350) is SENSE
    late.machine_us = 500
    assert port.receive(850) is SENSE
    assert late.machine_us == 9000
    assert late.now_us <= 850


def test_an_amplifier_that_falls_silent_is_waited_for_once_until_it_answers_again():
    late = Late((100, SENSE), (90_000, SENSE), (99_000, SENSE))
    port = waiting(late)
    port.receive(350)
    late.machine_us = 500
    assert port.receive(850) is None
    waited_us = late.machine_us - 850
    assert STANDS_US <= waited_us <= STANDS_US + 200
    assert port.receive(late.now_us + 350) is None
    assert late.machine_us <= 850 + waited_us + 450
    late.machine_us = 90_000
    assert port.receive(late.now_us + 350) is SENSE
    assert port.receive(late.now_us + 350) is SENSE
    assert late.machine_us == 99_000


def test_other_frames_are_handed_on_and_nothing_that_is_due_at_once_is_waited_for():
    late = Late((100, SENSE), (400, OTHER), (700, SENSE))
    port = waiting(late)
    assert port.receive(350) is SENSE
    assert port.receive(0) is None  # a look at what is there
    assert late.machine_us == 100
    assert port.receive(350) is OTHER
    assert port.receive(350) is SENSE
    assert late.now_us <= 350


def test_an_amplifier_is_waited_for_from_the_first_tick_on():
    late = Late((2000, SENSE))
    assert waiting(late).receive(350) is SENSE
    assert late.machine_us == 2000
