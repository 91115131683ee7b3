"""Clocks at the machine's pace. Lateness belongs to the machine: what is asserted is what the clock itself decides."""

import os
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.io.clocks import TickClock, WallClock, percentile_us
from pkxyz_ctrl.io.realtime import go_real_time, leave_real_time, settle_memory

pytestmark = pytest.mark.at_rate

PERIOD_US, LATEST_US, GUARD_US = 1000, 300, 125


class Scripted:
    """Time that stands still but for what the script says: each wait ends so late, each tick takes so long."""

    def __init__(self, late_us):
        self.now_us = 0
        self._late_us = iter(late_us)

    def wait_until(self, t_us):
        if t_us > self.now_us:
            self.now_us = t_us + next(self._late_us, 0)

    def stand_at(self, t_us):
        self.now_us = min(self.now_us, t_us)


def test_wall_clock_never_returns_early_and_counts_microseconds():
    clock = WallClock()
    before_ns = time.monotonic_ns()
    start_us = clock.now_us
    for wait_us in (0, 1, 40, 200, 3000):
        target_us = clock.now_us + wait_us
        clock.wait_until(target_us)
        assert clock.now_us >= target_us
    elapsed_us = clock.now_us - start_us
    assert elapsed_us <= (time.monotonic_ns() - before_ns) / 1000 + 1
    assert elapsed_us >= 3241
    assert isinstance(clock.now_us, int)


def test_neither_the_past_nor_computing_is_waited_for(monkeypatch):
    """Nothing sleeps, and nothing looks at the clock again and again."""
    clock = WallClock()
    looks, later_ns = [], time.monotonic_ns() + 10**9

    def looked():
        looks.append(later_ns)
        assert len(looks) < 10
        return later_ns

    def slept(seconds):
        pytest.fail(f"slept for {seconds} s")

    monkeypatch.setattr(time, "monotonic_ns", looked)
    monkeypatch.setattr(time, "sleep", slept)
    clock.wait_until(0)
    clock.wait_until(clock.now_us - 1)
    clock.spend(10**9)


def test_sleeping_leaves_most_of_the_time_to_others():
    clock = WallClock()
    cpu_s, wall_us = time.process_time(), clock.now_us
    for tick in range(1, 21):
        clock.wait_until(wall_us + tick * 5000)
    assert time.process_time() - cpu_s < 0.5 * (clock.now_us - wall_us) * 1e-6


@settings(max_examples=200)
@given(
    late_us=st.lists(st.integers(0, 2500), max_size=60),
    work_us=st.lists(st.integers(1, 3300), min_size=1, max_size=25),
)
def test_ticks_keep_their_phase_their_distance_and_their_number(late_us, work_us):
    """As ``runtime.run`` uses it: whatever is late, a tick begins in phase, in time to be answered, and a guard after
    the end of the last.
    """
    scripted = Scripted(late_us)
    clock = TickClock(scripted, PERIOD_US, latest_start_us=LATEST_US, guard_us=GUARD_US)
    t_us, ended_us, skipped = PERIOD_US, 0, 0
    for work in work_us:
        clock.wait_until(t_us)
        overrun = (clock.now_us - t_us) // PERIOD_US
        skipped += overrun
        t_us += overrun * PERIOD_US
        assert 0 <= clock.now_us - t_us <= LATEST_US
        assert t_us % PERIOD_US == 0
        assert t_us - ended_us >= GUARD_US
        scripted.now_us += work
        ended_us = scripted.now_us
        t_us += PERIOD_US
    assert t_us == (1 + len(work_us) + skipped) * PERIOD_US
    assert sum(clock.lateness_us) >= len(work_us)


def test_a_punctual_loop_skips_nothing_and_a_late_one_no_more_than_it_must():
    for late, work, expected in ((0, 800, 0), (300, 500, 0), (301, 100, 1), (0, 875, 0), (0, 876, 1), (0, 1876, 2)):
        scripted = Scripted([0, late])  # the first wait is the one for late frames
        clock = TickClock(scripted, PERIOD_US, latest_start_us=LATEST_US, guard_us=GUARD_US)
        clock.wait_until(1000)
        begun_us = 1000 * (scripted.now_us // 1000)
        scripted.now_us = begun_us + max(work, scripted.now_us - begun_us)
        clock.wait_until(begun_us + 1000)
        assert (begun_us - 1000) // 1000 + (scripted.now_us - begun_us - 1000) // 1000 == expected


@settings(max_examples=200)
@given(
    late_us=st.lists(st.integers(0, 50_000), max_size=60),
    work_us=st.lists(st.integers(1, 50_000), min_size=1, max_size=25),
)
def test_where_time_may_stand_still_no_tick_is_given_up_and_none_begins_or_ends_late(late_us, work_us):
    scripted = Scripted(late_us)
    clock = TickClock(scripted, PERIOD_US, latest_start_us=LATEST_US, guard_us=GUARD_US, standstill_us=50_000)
    computed_us = 0
    for tick, work in enumerate(work_us, 1):
        t_us = tick * PERIOD_US
        clock.wait_until(t_us)
        assert t_us <= scripted.now_us <= t_us + LATEST_US
        assert t_us - computed_us >= 2 * GUARD_US
        scripted.now_us += work
        clock.spend(0)
        computed_us = scripted.now_us
        assert computed_us <= t_us + PERIOD_US - 2 * GUARD_US


@pytest.mark.parametrize(("late_us", "skipped"), [(5000, 0), (5001, 5)])
def test_time_does_not_stand_still_for_longer_than_it_may(late_us, skipped):
    scripted = Scripted([0, late_us])
    clock = TickClock(scripted, PERIOD_US, latest_start_us=LATEST_US, guard_us=GUARD_US, standstill_us=5000)
    clock.wait_until(1000)
    assert scripted.now_us == 1000 + 1000 * (skipped + bool(skipped))


def test_a_clock_that_stood_still_goes_on_from_there_and_says_for_how_long():
    clock = WallClock()
    clock.wait_until(5000)
    clock.stand_at(2000)
    assert 2000 <= clock.now_us < 5000
    assert clock.stood_us >= 3000
    stood_us = clock.stood_us
    clock.stand_at(10**9)  # not yet
    assert clock.stood_us == stood_us


def test_late_frames_are_taken_before_the_tick_and_leaving_ends_the_loop():
    scripted, taken = Scripted([]), []
    clock = TickClock(
        scripted, PERIOD_US, latest_start_us=LATEST_US, guard_us=GUARD_US,
        late_frames=lambda until_us: taken.append((scripted.now_us, until_us)),
    )  # fmt: skip
    for t_us in (1000, 2000, 3000):
        clock.wait_until(t_us)
    looks = [
        (1000 * n, 1000 * n + 938) for n in range(3)
    ]  # once when the tick before is done, as long as there is time
    last_looks = [(1000 * n + 938, 1000 * n + 1000) for n in range(3)]  # and once shortly before the next
    assert taken == sorted(looks + last_looks)

    def leave():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        TickClock(scripted, PERIOD_US, latest_start_us=1, guard_us=1, leave=leave).wait_until(9000)
    assert scripted.now_us == 3000


@given(st.lists(st.integers(0, 99), min_size=1, max_size=300), st.sampled_from([0.01, 0.5, 0.99, 0.999, 1.0]))
def test_percentile_is_the_least_lateness_that_covers_its_share(values, share):
    histogram = [values.count(us) for us in range(100)]
    found = percentile_us(histogram, share)
    assert sum(value <= found for value in values) >= share * len(values)
    assert sum(value <= found - 1 for value in values) < share * len(values)


def _open_files() -> list[str]:
    """Of this process, by name."""
    here = Path("/proc/self/fd")
    return [os.readlink(here / number) for number in os.listdir(here) if (here / number).is_symlink()]


def test_no_core_sleeps_while_a_loop_is_real_time():
    """Linux takes the wish back with the file: it must be open until then, and be opened once."""
    try:
        have = [go_real_time().partition("not permitted")[0] for _ in range(2)]
        kept = [name for name in _open_files() if name.endswith("cpu_dma_latency")]
        assert ["cores awake" in words for words in have] == 2 * [bool(kept)]
        assert len(kept) <= 1
    finally:
        leave_real_time()


def test_real_time_says_in_one_line_what_it_got_and_leaves_no_trace():
    import gc

    before = os.sched_getscheduler(0)
    try:
        words = go_real_time()
        settle_memory()
        got_fifo = os.sched_getscheduler(0) == os.SCHED_FIFO
        assert not gc.isenabled()
    finally:
        leave_real_time()
    assert "\n" not in words
    assert words.startswith("real time: ")
    have, _, lack = words.partition("not permitted: ")
    assert ("SCHED_FIFO" in have) == got_fifo
    assert ("SCHED_FIFO" in lack) == (not got_fifo)
    assert ("memory" in have) != ("memory" in lack)
    assert ("cores awake" in have) == os.access("/dev/cpu_dma_latency", os.W_OK)
    assert ("cores awake" in lack) != ("cores awake" in have)
    assert not [name for name in _open_files() if name.endswith("cpu_dma_latency")]
    assert os.sched_getscheduler(0) == before == os.SCHED_OTHER
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_without_permission_each_thing_that_lacks_is_named():
    """In a process without privileges, with no allowance for locked memory and priorities."""
    import subprocess
    import sys

    script = (
        "import os, resource\n"
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0)); resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "from pkxyz_ctrl.io.realtime import go_real_time\n"
        "if os.geteuid() == 0: os.setresuid(65534, 65534, 65534)\n"
        "print(go_real_time())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, env=os.environ)
    assert done.returncode == 0, done.stderr
    assert "not permitted: SCHED_FIFO (needs CAP_SYS_NICE" in done.stdout
    assert "locked memory (" in done.stdout
    assert "cores awake (" in done.stdout
    assert len(done.stdout.splitlines()) == 1
