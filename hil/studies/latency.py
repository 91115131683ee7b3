"""How punctual this machine is: the whole controller at rate, its amplifier played back from a run of the fast lane.

The port answers each SYNC at once with the sense frame that belongs to it, so what is measured is the machine, the
loop and the controller, and no bus. The loop is closed as far as the controller can tell: voltages come out bit for
bit as they did in the fast lane.
"""

import dataclasses
import os
import re
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.blocks import PREVIEW_ROWS
from hil.lanes.ending import Ended, Ending
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.lanes.wall import wall_gate
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.refused import reason
from pkxyz_ctrl.io.clocks import HISTOGRAM_US, TickClock, WallClock, count_us, percentile_us
from pkxyz_ctrl.io.realtime import FIFO_PRIORITY, go_real_time, leave_real_time, settle_memory
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.runtime import run
from pkxyz_ctrl.safety.modes import Mode

_SECONDS_MAX = 60.0
_PERIODS_US = (100, 100_000)


@dataclasses.dataclass
class Latency:
    """What was measured; histograms count by whole microseconds, the last entry all beyond."""

    period_us: int
    real_time: str
    """what the operating system permitted, in a line"""
    ticks: int
    missed_ticks: int
    lateness_us: list[int]
    """from the instant of a tick to the loop awake"""
    cycle_us: list[int]
    """from awake to the drive frame handed over and the row recorded"""
    cyclictest_us: list[int] | None
    """lateness of a bare thread in C at the same time, by cyclictest; None where it is not installed"""
    mode: int = int(Mode.IDLE)
    """of the controller in the end; TRACKING, unless it had no time to home"""
    ended_by: int = 0

    def figures(self) -> dict[str, Any]:
        """Percentiles, as plain data."""
        shares = {"p50": 0.5, "p99": 0.99, "p99_9": 0.999, "max": 1.0}

        def of(histogram: list[int] | None) -> dict[str, int] | None:
            return None if histogram is None else {name: percentile_us(histogram, s) for name, s in shares.items()}

        return {
            "period_us": self.period_us,
            "real_time": self.real_time,
            "ticks": self.ticks,
            "missed_ticks": self.missed_ticks,
            "lateness_us": of(self.lateness_us),
            "cycle_us": of(self.cycle_us),
            "cyclictest_us": of(self.cyclictest_us),
        }


class _Amplifier:
    """``runtime.Port`` that answers each SYNC at once with the next of the frames that it was given."""

    def __init__(self, sense: list[Frame]) -> None:
        self._sense = sense
        self._next = 0
        self._waiting: Frame | None = None

    def send(self, frame: Frame) -> None:
        if frame[0] == cob_id.SYNC:
            self._waiting = self._sense[self._next]
            self._next += 1

    def receive(self, deadline_us: int) -> Frame | None:
        waiting, self._waiting = self._waiting, None
        return waiting

    def unsent(self) -> int:
        return 0


class _Stopwatch:
    """A ``TickClock`` that notes when a tick is awake."""

    def __init__(self, clock: TickClock) -> None:
        self._clock = clock
        self.spend = clock.spend
        self.cycle_us = [0] * HISTOGRAM_US
        self._awake_ns = 0

    @property
    def now_us(self) -> int:
        return self._clock.now_us

    def wait_until(self, t_us: int) -> None:
        self._clock.wait_until(t_us)
        self._awake_ns = time.monotonic_ns()

    def stop(self, tick: int) -> None:
        """The tick is done."""
        count_us(self.cycle_us, (time.monotonic_ns() - self._awake_ns) // 1000)


def measure(period_us: int, seconds: float, cyclictest: str | None = None) -> Latency:
    """Run the default scenario's controller at ``period_us`` for ``seconds``.

    ``cyclictest``: path of the program to run beside it, None for none. Raises ``ConfigError`` for a period or
    a time out of range.
    """
    if not _PERIODS_US[0] <= period_us <= _PERIODS_US[1]:
        raise ConfigError(f"--period-us: {period_us} is not in {_PERIODS_US[0]}..{_PERIODS_US[1]}")
    if not 0.1 <= seconds <= _SECONDS_MAX:
        raise ConfigError(f"--seconds: {seconds:g} is not in 0.1..{_SECONDS_MAX:g}")
    setup = _setup(period_us, seconds)
    amplifier = _Amplifier(_played(setup))
    controller = Controller(setup.law, setup.bus, wall_gate(setup.gate), amplifier.send)
    controller.memory["mode"] = Mode.IDLE  # as after the start-up, which a played amplifier cannot answer
    reference = reference_rows(setup.trajectory.sample(0, setup.ticks + PREVIEW_ROWS, period_us))
    cycling.cycle(setup.law, cycling.new_memory(), reference)
    beside = start_cyclictest(cyclictest, period_us, seconds)
    with Ending() as ending:
        clock = TickClock(
            WallClock(), period_us, latest_start_us=period_us // 3, guard_us=period_us // 8, leave=ending.check
        )
        watch = _Stopwatch(clock)
        result = Latency(period_us, go_real_time(), setup.ticks, 0, clock.lateness_us, watch.cycle_us, None)
        settle_memory()
        try:
            run(watch, amplifier, controller, lambda tick: reference, setup.ticks, watch.stop)
            result.missed_ticks = controller.missed_ticks
        except Ended as end:
            result.ended_by = end.signal_number
            result.ticks = sum(watch.cycle_us)
        finally:
            leave_real_time()
            result.mode = controller.mode
    if beside is not None:
        if result.ended_by:
            beside.terminate()
        result.cyclictest_us = read_cyclictest(beside.communicate()[0])
    return result


def _setup(period_us: int, seconds: float) -> Setup:
    setup = load_scenario("raster").setup()
    assert setup.bus.can is not None
    can = setup.bus.can.model_copy(
        update={"sense_deadline_us": period_us // 2, "heartbeat_deadline_us": 3 * period_us // 4, "compute_us": 0}
    )
    bus = setup.bus.model_copy(update={"period_us": period_us, "can": can})
    return dataclasses.replace(setup, bus=bus, duration_s=seconds)


def _played(setup: Setup) -> list[Frame]:
    """The sense frames of a run in the fast lane."""
    counts: list[NDArray[np.int32]] = []
    lanes.run(setup, Lane.FAST, on_block=lambda block: counts.append(block["sense_count"].copy()))
    assert setup.bus.can is not None
    driver = setup.bus.can.driver
    codec = ProcessCodec(cob_id.SENSE_BASE + driver.node_id, driver.protection)
    return [
        Frame(codec.cob_id, codec.encode((a, b, c), index & 0xFF), driver.fd, driver.fd)
        for index, (a, b, c) in enumerate(np.concatenate(counts).tolist())
    ]


def start_cyclictest(path: str | None, period_us: int, seconds: float) -> "subprocess.Popen[str] | None":
    """``cyclictest`` at ``path`` for so long, at our priority; None for None. Raises ``ConfigError``."""
    if path is None:
        return None
    real_time = ["-m", "-p", str(FIFO_PRIORITY)] if os.geteuid() == 0 else []
    loops = round(seconds * 1e6 / period_us)
    words = [path, "-q", "-t1", *real_time, "-i", str(period_us), "-l", str(loops), "-h", str(HISTOGRAM_US)]
    try:
        return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    except OSError as error:
        raise ConfigError(f"--cyclictest: {Path(path)}: {reason(error)}") from None


def read_cyclictest(text: str) -> list[int] | None:
    """The histogram that ``cyclictest -h`` prints, its overflows in the last entry; None if there is none."""
    counts = [0] * HISTOGRAM_US
    for late_us, count in re.findall(r"^(\d{6}) (\d+)$", text, flags=re.MULTILINE):
        count_us(counts, int(late_us), int(count))
    overflows = re.search(r"^# Histogram Overflows: (\d+)", text, flags=re.MULTILINE)
    counts[-1] += int(overflows[1]) if overflows else 0
    return counts if any(counts) else None
