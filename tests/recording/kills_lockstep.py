"""Kills at any microsecond, in lockstep's clock: SIGKILL, SIGTERM, and SIGSTOP for 1 to 500 ms, of controller and
amplifier; and a recorder whose file is cut at any byte.

One run goes through start-up, homing, tracking, a fault and its clear. At random instants its process forks: the child
kills somebody and looks on until the combs have to be at 0 V; the parent goes on as if nothing had been.
``python tests/recording/kills_lockstep.py 10000``, part of ``make kills``, makes so many; the suite makes some.
"""

import os
import random
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

import hil.lanes.lockstep as lane  # noqa: E402
from hil.bus.clock import Lockstep  # noqa: E402
from hil.faults.fault import parse  # noqa: E402
from hil.lanes.blocks import Blocks  # noqa: E402
from hil.lanes.setup import Setup  # noqa: E402
from hil.node.wired import wired_node  # noqa: E402
from hil.plant.on_bus import PlantOnBus  # noqa: E402
from hil.recording.recording import Recording, RecordingError, RecordingWriter, journal_of  # noqa: E402
from hil.runs.scenario import load_scenario  # noqa: E402
from pkxyz_ctrl.loop.controller import StartUpError  # noqa: E402
from pkxyz_ctrl.loop.row import ROW  # noqa: E402
from pkxyz_ctrl.safety.modes import Mode  # noqa: E402

RUN_US = 1_100_000  # and a start-up before it
START_UP_US = 130_000
DRIVE, ZERO = 0x30A, (0, 0, 0)
DRIVE_TIMEOUT_US = 20_000  # 0x2012: the longest that a comb keeps a voltage without a controller
WATCHED_US = 80_000  # beyond every time-out of the fault decision
WHO = ("controller killed", "controller ended", "controller stopped", "amplifier killed", "amplifier stopped")


class Gone(Exception):  # noqa: N818
    """The controller's program is no more."""


class Over(Exception):  # noqa: N818
    """Enough was seen."""


class Stoppable(Lockstep):
    """The controller waits with this clock: stopped, it does not come back before ``until_us``."""

    until_us = 0

    def run_until(self, t_us):
        super().run_until(t_us)
        if self.until_us > self.now_us:
            super().run_until(self.until_us)

    def spend(self, compute_us):
        self.run_until(self.now_us + compute_us)

    def run_while_empty(self, queue, t_us):
        super().run_while_empty(queue, t_us)
        self.run_until(self.now_us)


class Witness(PlantOnBus):
    """Notes what is put on the combs."""

    def __init__(self, plant):
        super().__init__(plant)
        self.applied = [(0, ZERO)]

    def exchange(self, t_us, counts, *, sample):
        if counts is not None:
            self.applied.append((t_us, tuple(counts)))
        return super().exchange(t_us, counts, sample=sample)


class Amplifier:
    """The node's process: what reaches it and leaves it, unless it is killed or stopped."""

    def __init__(self, can, clock, send, plant):
        self.node = wired_node(can, clock, self.send, plant)
        self._receive, self.node.on_frame = self.node.on_frame, self.receive
        self._clock, self._send = clock, send
        self._until_us, self._waiting = 0, []

    def send(self, frame):
        if self._clock.now_us >= self._until_us:
            self._send(frame)
        else:
            self._waiting.append((self._send, (frame,)))

    def receive(self, frame, t_us):
        if self._clock.now_us >= self._until_us:
            self._receive(frame, t_us)
        else:
            self._waiting.append((self._receive, (frame, t_us)))

    def stop(self, until_us):
        self._until_us = until_us
        self._clock.call_at(until_us, self._go_on)

    def _go_on(self):
        waiting, self._waiting = self._waiting, []
        for take, (frame, *_) in waiting:
            take(frame, *_ and (self._clock.now_us,))


class Kills:
    """One run, and ``count`` children of it; ``failures`` says what they saw that must not be."""

    def __init__(self, count, seed, folder):
        scenario = load_scenario("raster", faults=(parse("bus.sync:drop@0.6+0.05"),))
        scenario.config.__dict__.update(duration_s=RUN_US * 1e-6, clear_s=0.02)
        self.setup: Setup = scenario.setup()
        self.outcomes, self.failures = Counter(), []
        self._random = random.Random(f"kills {seed}")
        self._instants = sorted(self._random.sample(range(START_UP_US + RUN_US), count))
        self._folder, self._children, self._is_child = folder, [], False
        self.modes = Counter()

    def run(self):
        """Let the run go, and collect what its children leave."""
        before = lane.Lockstep, lane.plant_of, lane.wired_node
        lane.Lockstep, lane.wired_node = Stoppable, self._wired
        lane.plant_of = lambda plant, *_: Witness(plant)
        try:
            self.rig = rig = lane.LockstepRig(self.setup)
            self.drives = []
            rig.wire.attach("listener", on_frame=self._listen)
            for number, t_us in enumerate(self._instants):
                rig.clock.call_at(t_us, lambda number=number: self._fork(number))
            setup = self.setup
            blocks = Blocks(setup.trajectory, setup.bus.period_us, setup.ticks, lambda rows: None, lambda *done: None)
            try:
                rig.run(blocks)
            except Exception as end:
                if not self._is_child:
                    raise
                self._end_of_child(end)
            if self._is_child:
                self._end_of_child(Over())
        finally:
            lane.Lockstep, lane.plant_of, lane.wired_node = before
        while self._children:
            self._reap()

    def _wired(self, can, clock, send, plant, switch):
        self.amplifier = Amplifier(can, clock, send, plant)
        return self.amplifier.node

    def _listen(self, frame, t_us):
        if frame.can_id == DRIVE:
            self.drives.append((t_us, any(frame.data[:6])))

    # -- children ---------------------------------------------------------------------------------------------------

    def _fork(self, number):
        if self._is_child:
            return
        while len(self._children) >= len(os.sched_getaffinity(0)):
            self._reap()
        who, stop_us = self._random.choice(WHO), self._random.randrange(1000, 500_001)
        mode = Mode(self.rig.controller.mode).name
        pid = os.fork()
        if pid:
            self._children.append((pid, number, who))
            self.modes[mode] += 1
            return
        self._is_child, self._number = True, number
        self._kill(who, stop_us)

    def _reap(self):
        pid, number, who = self._children.pop(0)
        os.waitpid(pid, 0)
        file = self._folder / str(number)
        told = file.read_text() if file.exists() else "ended without a word"
        file.unlink(missing_ok=True)
        self.outcomes[who] += 1
        if told:
            self.failures.append(f"{who} at {self._instants[number]} us: {told}")

    def _kill(self, who, stop_us):
        clock = self.rig.clock
        self._who, self._at_us, self._mark = who, clock.now_us, len(self.rig.plant.applied) - 1
        self._stop_us = stop_us if who.endswith("stopped") else 0
        clock.call_at(clock.now_us + self._stop_us + WATCHED_US, self._over)
        if who in ("controller killed", "controller ended"):
            raise Gone
        if who == "controller stopped":
            clock.until_us = clock.now_us + stop_us
        else:
            self.amplifier.stop(clock.now_us + (stop_us if self._stop_us else 1 << 40))

    def _over(self):
        raise Over

    def _end_of_child(self, end):
        """Say what must not be, and end without any tidying up."""
        told = ""
        try:
            if isinstance(end, Gone | StartUpError):
                self._outlive(is_asked=isinstance(end, StartUpError) or self._who == "controller ended")
            elif not isinstance(end, Over):
                raise end
            told = "; ".join(self._verdicts())
        except BaseException:
            told = traceback.format_exc()
        (self._folder / str(self._number)).write_text(told)
        os._exit(0)

    def _outlive(self, *, is_asked):
        """The controller is gone; ``is_asked``: not without its last words."""
        clock, period_us = self.rig.clock, self.setup.bus.period_us
        clock.until_us = 0
        with suppress(Over):
            if is_asked:
                clock.run_until(clock.now_us + period_us // 2)  # or the gate takes it for a babbling node
                self.rig.controller.stop(clock.now_us)
            clock.run_until(1 << 40)

    def _verdicts(self):
        applied, end_us = self.rig.plant.applied[self._mark :], self.rig.clock.now_us
        limit, step = self.setup.gate.count_max, self.setup.gate.count_slew_max
        for (_, old), (t_us, new) in pairwise(applied):
            if max(new) > limit:
                yield f"{new} at {t_us} us is beyond the limit of {limit}"
            if new != ZERO and any(abs(a - b) > step for a, b in zip(new, old, strict=True)):
                yield f"a step from {old} to {new} at {t_us} us, more than {step}"
        silent_us = end_us - self._at_us if not self._stop_us else self._stop_us
        if self._who.startswith("controller") and silent_us > DRIVE_TIMEOUT_US + 2000:
            by_us = self._at_us + (DRIVE_TIMEOUT_US if self._who != "controller ended" else 0) + 1000
            for t_us, counts in _during(applied, by_us, self._at_us + silent_us):
                yield f"{counts} on the combs at {t_us} us, though nobody controls them"
        is_watched = end_us >= self._at_us + self._stop_us + WATCHED_US  # the run may have ended before
        if self._who.startswith("amplifier") and is_watched:
            mode = self.rig.controller.mode
            if self._who == "amplifier killed" and mode >= Mode.IDLE and mode != Mode.FAULT:
                yield f"in {Mode(mode).name} without an amplifier"
            if mode == Mode.FAULT and any(is_driven for t_us, is_driven in self.drives if t_us > end_us - 20_000):
                yield "voltages are sent in FAULT"


def _during(applied, begin_us, end_us):
    """What stood on the combs between two instants and is not 0 V."""
    ends = [t_us for t_us, _ in applied[1:]] + [end_us]
    for (t_us, counts), until_us in zip(applied, ends, strict=True):
        if counts != ZERO and until_us > begin_us and t_us < end_us:
            yield max(t_us, begin_us), counts


def cut_recordings(count, seed, folder):
    """A journal, cut at ``count`` places: its whole rows open, and it says that it is cut. Returns how many were cut
    within their first line, and refused.
    """
    path = Path(folder) / "cut.parquet"
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, 256, (300, ROW.itemsize), np.uint8).view(ROW)[:, 0]
    rows["tick"] = np.arange(len(rows))
    writer = RecordingWriter(path, {"of": "a test"})
    writer.write(rows)
    writer.flush()
    content = journal_of(path).read_bytes()
    begin = content.index(b"\n") + 1
    assert len(content) == begin + rows.nbytes
    refused = 0
    for number in range(count):
        size = int(rng.integers(0, 2 * begin if number % 2 else len(content)))
        journal_of(path).write_bytes(content[:size])
        opened = _opened(path)
        if opened is None:
            assert size < begin, size
            refused += 1
            continue
        assert not opened.whole
        assert opened.ticks == (size - begin) // ROW.itemsize
        assert opened["tick"].tolist() == list(range(opened.ticks))
    return refused


def _opened(path):
    """A recording; None if it is said, in a line, that it is none."""
    with suppress(RecordingError):
        return Recording.open(path)
    return None


def main(count):
    """Kill ``count`` times, tell what was seen; exit code 1 if something must not be."""
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        kills = Kills(count, 1, Path(folder))
        kills.run()
        cut = max(1, count // 10)
        refused = cut_recordings(cut, 1, folder)
    for failure in kills.failures[:20]:
        print(failure)
    print(f"{count} kills in {time.monotonic() - begin_s:.0f} s: {dict(kills.outcomes)}, in {dict(kills.modes)}")
    print(f"{len(kills.failures)} of them left what must not be; {cut} recordings cut, {refused} in their first line")
    return 1 if kills.failures else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
