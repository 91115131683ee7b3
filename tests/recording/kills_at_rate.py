"""Kills at rate: SIGKILL, SIGTERM, and SIGSTOP for 1 to 500 ms, of controller, plant and recorder, each a process of
its own on a bus among processes, in start-up, tracking, fault, and the clear after it.

``python tests/recording/kills_at_rate.py 300``, part of ``make kills``, makes so many; the suite makes some. A busy
machine does the same to these processes as is done here on purpose, so no verdict depends on how busy it is.
"""

import json
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import contextmanager, suppress
from itertools import count, pairwise
from pathlib import Path

import can
import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "rigs")]

from patience import patient_law, replaced  # noqa: E402

import hil.commands.run  # noqa: E402  what a command loads when it is called, loaded before processes part
import hil.pictures.wall  # noqa: E402, F401
from hil.bus.unix_bus import UnixBus  # noqa: E402
from hil.cli import main as pkxyz  # noqa: E402
from hil.lanes import wall, wall_plant  # noqa: E402
from hil.recording.recording import Recording, journal_of  # noqa: E402
from hil.runs import at_rate  # noqa: E402
from hil.runs.scenario import load_scenario  # noqa: E402
from pkxyz_ctrl.config.files import find  # noqa: E402
from pkxyz_ctrl.loop.reference import standing_still  # noqa: E402
from pkxyz_ctrl.safety.modes import Mode  # noqa: E402

WHO = ("controller", "plant", "recorder")
HOW = ("killed", "stopped", "ended")
WHEN = ("start-up", "tracking", "fault", "clear")
DRIVE_TIMEOUT_US = 100_000  # 0x2012, as long as what the node allows between our heartbeats
LATE_US = 50_000  # for the process of the plant
CLEAR_TICKS = 40
SILENT_S = 1.5  # an amplifier that is silent for so long is missed, on any machine
ZERO_S = LONGEST_S = 60.0  # for what a busy machine does not do at once
STOP_ALL = can.Message(arbitration_id=0, data=[2, 0], is_extended_id=False)
_TIME_OUTS = """node_heartbeat_timeout_ms = 300
controller_heartbeat_timeout_ms = 100
drive_timeout_ms = 100
boot_timeout_us = 20_000_000
start_timeout_us = 5_000_000
sdo_timeout_us = 5_000_000
"""


class ClearingRig(wall.WallRig):
    """The loop of ``pkxyz run``, with somebody at it who clears a fault some ticks later."""

    def run(self):
        waited, row, controller = [0], self._recorder.row, self.controller

        def row_and_clear(content):
            row(content)
            waited[0] = waited[0] + 1 if controller.mode in (Mode.FAULT, Mode.BOOT) else 0
            if waited[0] % CLEAR_TICKS == CLEAR_TICKS - 1:
                controller.clear()

        self._recorder.row = row_and_clear
        super().run()


def prepared(folder):
    """A scenario's files; and this process has loaded what the processes that it forks need."""
    patient_law(folder, "youla")
    bus = replaced('^channel = "pkxyz"', f'channel = "{folder}/bus"', find("buses", "unix_1k").read_text())
    (folder / "bus.toml").write_text(bus + _TIME_OUTS)
    scenario = replaced(r"^duration_s = 1\.1", "duration_s = 600", find("scenarios", "raster").read_text())
    scenario = replaced("^controller = .*", 'controller = "patient.toml"', scenario)
    (folder / "long.toml").write_text(replaced("^bus = .*", 'bus = "bus.toml"', scenario))
    setup = load_scenario(folder / "long.toml").setup()
    wall._warm_up(setup.law, standing_still())
    wall_plant._warm_up(setup)


class Command:
    """``pkxyz`` in a process of its own, its streams in files."""

    def __init__(self, folder, *words):
        self.name, self._streams = words[0], [folder / f"{words[0]}.{name}" for name in ("out", "err")]
        for path in self._streams:
            path.write_text("")
        self.code = None
        self.pid = os.fork()
        if self.pid == 0:
            self._be(folder, words)

    def _be(self, folder, words):
        code = 1
        try:
            os.chdir(folder)
            for number, path in zip((1, 2), self._streams, strict=True):
                stream = path.open("w")
                os.dup2(stream.fileno(), number)
                setattr(sys, ("stdout", "stderr")[number - 1], stream)
            sys.argv = ["pkxyz", *words]
            at_rate.WallRig = ClearingRig
            try:
                pkxyz()
                code = 0
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 1
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)

    @property
    def said(self):
        return [path.read_text() for path in self._streams]

    def signal(self, number):
        if self.code is None:
            os.kill(self.pid, number)

    def has_ended(self):
        """Whether it has; its ``code`` says how."""
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if pid else None
        return self.code is not None

    def child(self):
        """Process id of what it has forked, None if there is nothing."""
        try:
            children = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text().split()
        except OSError:
            return None
        return int(children[0]) if children else None

    def kill(self):
        with suppress(ProcessLookupError):
            self.signal(signal.SIGCONT)
            self.signal(signal.SIGKILL)
        waited_for(self.has_ended, f"{self.name} is not gone")


def waited_for(happened, otherwise, longest_s=LONGEST_S):
    """What ``happened`` returns, once that is something."""
    end_s = time.monotonic() + longest_s
    while not (seen := happened()):
        assert time.monotonic() < end_s, otherwise() if callable(otherwise) else otherwise
        time.sleep(0.002)
    return seen


class Kill:
    """One controller and one plant, one of which, or the recorder, is killed, stopped or ended."""

    def __init__(self, folder, seed):
        rng = random.Random(f"kill at rate {seed}")
        self.who, self.how, self.when = rng.choice(WHO), rng.choice(HOW), rng.choice(WHEN)
        self._delay_s = rng.uniform(0.0, 0.06 if self.when == "fault" else 0.4)
        self._stop_s = rng.randrange(1000, 500_001) * 1e-6
        self._folder, self._run = folder, folder / f"run-{seed}"
        self._truth = folder / f"truth-{seed}"

    def __str__(self):
        length = f" for {1e3 * self._stop_s:.0f} ms" if self.how == "stopped" else ""
        return f"{self.who} {self.how}{length} {1e3 * self._delay_s:.0f} ms into {self.when}"

    def outcome(self):
        """What was left of the recording. Raises ``AssertionError`` where that, or a voltage, must not be."""
        words = ("long.toml", "--bus", "bus.toml", "--json")
        with running(self._folder, "plant", *words, "--truth", str(self._truth)) as self.plant:
            waited_for(lambda: self.changes, lambda: f"no plant: {self.plant.said}")
            with running(self._folder, "run", *words, "--out", str(self._run)) as self.controller:
                self._wait_until_it_is_time()
                ended_by = self._strike()
                self._finish()
            if ended_by != "plant":
                waited_for(lambda: not self.changes[-1]["driven"], "voltage without a controller", ZERO_S)
        self._require_voltages()
        return self._left(ended_by)

    @property
    def changes(self):
        """What the plant said of its node."""
        return [json.loads(line) for line in self.plant.said[0].splitlines(keepends=True) if line.endswith("\n")]

    # -- what is done -----------------------------------------------------------------------------------------------

    def _wait_until_it_is_time(self):
        if self.when != "start-up":
            waited_for(lambda: self.changes[-1]["driven"] or self.controller.has_ended(), self._told)
        if self.when in ("fault", "clear"):
            since = len(self.changes)
            with UnixBus(f"{self._folder}/bus") as somebody:
                somebody.send(STOP_ALL)
            states = [] if self.when == "fault" else ["operational"]
            waited_for(lambda: self._has_shown(since, ["pre-operational", *states]), self._told)
        else:
            waited_for(lambda: self.controller.child() or self.controller.has_ended(), self._told)
        time.sleep(self._delay_s)

    def _has_shown(self, since, states):
        left = [change["state"] for change in self.changes[since:]]
        for state in states:
            if state not in left:
                return self.controller.has_ended()
            left = left[left.index(state) :]
        return True

    def _strike(self):
        """Whose end that is for good, empty for nobody's."""
        victim = {"controller": self.controller.pid, "plant": self.plant.pid, "recorder": self.controller.child()}
        pid = victim[self.who]
        if self.controller.has_ended() or pid is None:
            return ""
        with suppress(ProcessLookupError):
            if self.how == "stopped":
                os.kill(pid, signal.SIGSTOP)
                time.sleep(self._stop_s)
                os.kill(pid, signal.SIGCONT)
                time.sleep(self._delay_s)
                return ""
            os.kill(pid, signal.SIGKILL if self.how == "killed" else signal.SIGTERM)
        if self.who == "recorder" and self.how == "ended":  # it is deaf to that: its end is the loop's
            time.sleep(self._delay_s)
            return ""
        return self.who

    def _finish(self):
        """Who is not gone by itself, as a controller in FAULT whose amplifier is gone, is asked to."""
        end_s = time.monotonic() + SILENT_S
        while self.who == "plant" and self.how != "stopped" and time.monotonic() < end_s:
            if self.controller.has_ended():
                return
            time.sleep(0.01)
        self.controller.signal(signal.SIGTERM)
        waited_for(self.controller.has_ended, self._told)

    def _told(self):
        return f"{self.changes[-3:]}; the controller said {self.controller.said}"

    # -- what must be -----------------------------------------------------------------------------------------------

    def _require_voltages(self):
        """Where no SYNC came, the combs were at 0 V in the time of 0x2012, by the node's own clock; a process that is
        stopped itself says so later.
        """
        longest_us = DRIVE_TIMEOUT_US + LATE_US
        if (self.who, self.how) == ("plant", "stopped"):
            longest_us += round(1e6 * self._stop_s)
        seen_us = np.fromfile(self._truth, wall_plant.TRUTH)["t_us"]
        changes = [(round(1e6 * change["t_s"]), change["driven"]) for change in self.changes]
        for (from_us, is_driven), (to_us, _) in pairwise(changes):
            if is_driven:
                syncs_us = seen_us[(seen_us >= from_us) & (seen_us <= to_us)]
                silent_us = np.diff(np.array([from_us, *syncs_us, to_us]))
                assert silent_us.max() <= longest_us, f"driven {silent_us.max()} us without a SYNC"

    def _left(self, ended_by):
        path, code = self._run / "recording.parquet", self.controller.code
        if not path.exists() and not journal_of(path).exists():
            assert ended_by or code == -signal.SIGTERM, f"no recording, exit code {code}: {self._told()}"
            return "no recording yet"
        recording = Recording.open(path)
        missing = np.diff(recording["tick"]) - 1
        assert (missing == 0).all(), f"rows are missing: {missing.max()}"
        at_fault = recording["mode"] == Mode.FAULT
        assert not recording.vector("drive_count")[at_fault].any(), "counts in FAULT"
        if ended_by in ("controller", "recorder") and self.how == "killed":
            assert not recording.whole, "cut off, and says that it is whole"
            if ended_by == "recorder":
                assert code == 2, code
                assert "was killed by signal 9" in self.controller.said[1]
            return "cut off, and says so"
        if ended_by == "plant" and recording.ticks:
            last = Mode(int(recording["mode"][-1]))  # in the middle of a start-up after a clear, say
            assert last in (Mode.BOOT, Mode.PRE_OPERATIONAL, Mode.FAULT), f"{last.name} without an amplifier"
        assert recording.whole, f"not whole, exit code {code}: {self._told()}"
        summary = json.loads((self._run / "summary.json").read_text())
        assert summary["ticks"] == recording.ticks, (summary["ticks"], recording.ticks)
        return "whole"


def the_first(folder, who, how, when, begin=0):
    """The first of the random kills from ``begin`` on that is such a one."""
    for seed in count(begin):
        kill = Kill(folder, seed)
        if (kill.who, kill.how, kill.when) == (who, how, when):
            return kill


@contextmanager
def running(folder, *words):
    """A command that is gone at the end of this, asked first."""
    command = Command(folder, *words)
    try:
        yield command
        command.signal(signal.SIGTERM)
        waited_for(command.has_ended, lambda: f"{words[0]} does not end: {command.said}")
    finally:
        command.kill()


def main(number):
    """Kill ``count`` times, tell what was left; exit code 1 if something must not be."""
    begin_s, outcomes, failures = time.monotonic(), Counter(), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepared(folder)
        for seed in range(number):
            kill = Kill(folder, seed)
            try:
                outcomes[kill.when, f"{kill.who} {kill.how}", kill.outcome()] += 1
            except Exception:
                failures += 1
                print(f"seed {seed}: {kill}: {traceback.format_exc()}", flush=True)
    for (when, what, left), times in sorted(outcomes.items()):
        print(f"{times:4} {when}, {what}: {left}")
    print(f"{number} kills at rate in {time.monotonic() - begin_s:.0f} s, {failures} of them left what must not be")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
