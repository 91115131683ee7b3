"""Does the loop allocate anything that grows? Controller and plant, two processes on the machine's clock, for minutes.

    python benchmarks/endurance.py [--minutes 10] [--bus unix_2k] [--out docs/figures/endurance.json]

Circles all the while, over Unix sockets, with the garbage collector off, as ever in a run at rate. Once a second:
memory of controller, plant and the recording's writer that is their own, not that of files which they have touched;
blocks that Python has allocated; bytes that tracemalloc counts, which slows the loop a little. Writes JSON and, beside
it, a picture; exit code 1 if something grew. Monitors of punctuality are off, and the node is patient; where a busy
machine loses frames all the same, the fault is cleared a second later, since a loop in FAULT would show nothing. What a
fault and its clear leave behind, a sentence, the emergencies, the garbage of a start-up, is counted apart.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.bench.suite import describe_machine
from hil.lanes.ending import Ended, Ending
from hil.lanes.lane import Lane
from hil.lanes.wall import WallRig
from hil.pictures.style import BLUE, FAINT, MUTED, ORANGE, VERMILION, dress, legend, save, sheet
from hil.recording.wall_recorder import WallRecorder
from hil.runs.run_folder import RunFolder, metadata_of
from hil.runs.scenario import Scenario, load_scenario
from pkxyz_ctrl.config.files import CONFIG_DIR
from pkxyz_ctrl.io.realtime import leave_real_time, settle_memory
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, Mode

Array = NDArray[np.float64]

OUT = Path(__file__).parents[1] / "docs" / "figures" / "endurance.json"
PUNCTUALITY = ("stale", "sequence", "innovation", "residual", "unexplained_force", "saturation", "overrun")
WARM_UP_SHARE, WARM_UP_MAX_S = 0.3, 60.0
GROWTH_MAX_KB, GROWTH_MAX_BLOCKS, GROWTH_MAX_TRACED_KB = 256, 100, 16
"""A byte kept of each of 1.2 million ticks would be 1200 kB."""
CIRCLE_HZ = 20.0
RESTART_S = 3
WHO = ("controller", "plant", "writer")
SCENARIO = """
name = "endurance"
duration_s = {duration_s}
seed = 1
stage = "reconstructed"
plant = "nominal"
controller = "lqg"
bus = "{bus}"
[[reference]]
kind = "hold"
duration_s = 0.02
measured = false
[[reference]]
kind = "move"
to_m = [0.0, 0.0, 19.2495e-6]
velocity_max_m_per_s = 0.2e-3
acceleration_max_m_per_s2 = 0.05
jerk_max_m_per_s3 = 10.0
[[reference]]
kind = "circle"
radius_m = 2.0e-6
frequency_hz = {frequency_hz}
turns = {turns}
lead_s = 0.1
"""


class Witness(WallRecorder):
    """A recorder that looks at the memory once a second. Its notes are made beforehand, so that noting takes none."""

    def __init__(self, folder: RunFolder, metadata: dict[str, Any], channel: str, ticks: int, period_us: int) -> None:
        super().__init__(folder.recording, folder.frames, metadata, channel)
        self._every = 1_000_000 // period_us
        self._left = self._every
        fields = dict(ROW.fields or {})
        self._mode_at, self._overrun_at = fields["mode"][1], fields["overrun"][1]
        self._files: list[int] = []
        self._rig: WallRig | None = None
        self.clears = 0
        self.closed_ticks = self.skipped_ticks = self.ticks = self.count = 0
        self.notes = np.zeros((ticks // self._every + 1, 6), np.int64)
        """three own kB, blocks, traced bytes, clears"""

    def watch(self, plant_pid: int, rig: WallRig) -> None:
        """Whose memory to look at, besides that of the two processes that are known here; whose faults to clear."""
        self._rig = rig
        self._files = [os.open(f"/proc/{pid}/statm", os.O_RDONLY) for pid in (os.getpid(), plant_pid, self.writer_pid)]

    def row(self, row: memoryview) -> None:
        super().row(row)
        self.ticks += 1
        self.closed_ticks += int(LOOP_CLOSED[row[self._mode_at]])
        self.skipped_ticks += int.from_bytes(row[self._overrun_at : self._overrun_at + 4], "little")
        self._left -= 1
        if self._left == 0:
            self._left = self._every
            note = self.notes[self.count]
            for place, file in enumerate(self._files):
                resident, of_files = map(int, os.pread(file, 100, 0).split()[1:3])
                note[place] = 4 * (resident - of_files)
            note[3], note[4] = sys.getallocatedblocks(), tracemalloc.get_traced_memory()[0]
            self.count += 1
            if self._rig is not None and self._rig.controller.mode in (Mode.FAULT, Mode.BOOT):
                self._rig.controller.clear()
                self.clears += 1
                note[5] = 1


def scenario_of(folder: Path, minutes: float, bus: str) -> Scenario:
    """Circles for so long, on a bus of its own, with a patient node and a patient controller."""
    duration_s = 60.0 * minutes
    text = (CONFIG_DIR / "buses" / f"{bus}.toml").read_text(encoding="utf-8")
    assert 'channel = "pkxyz"' in text
    text = text.replace('channel = "pkxyz"', f'channel = "{folder}/bus"')
    patience = "controller_heartbeat_timeout_ms = 900\nnode_heartbeat_timeout_ms = 900\ndrive_timeout_ms = 900\n"
    (folder / "bus.toml").write_text(text + patience, encoding="utf-8")
    words = SCENARIO.format(
        duration_s=duration_s, bus="bus.toml", frequency_hz=CIRCLE_HZ, turns=float(int((duration_s - 2.0) * CIRCLE_HZ))
    )
    (folder / "endurance.toml").write_text(words, encoding="utf-8")
    scenario = load_scenario(folder / "endurance.toml")
    off = {f"{name}_count": -1 for name in PUNCTUALITY}
    monitors = scenario.controller.monitors.model_copy(update=off)
    return dataclasses.replace(scenario, controller=scenario.controller.model_copy(update={"monitors": monitors}))


def run(minutes: float, bus: str) -> dict[str, Any]:
    """The run, and what was seen."""
    machine = describe_machine()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        scenario = scenario_of(folder, minutes, bus)
        setup = scenario.setup()
        run_folder = RunFolder(folder / "run")
        recorder = Witness(
            run_folder,
            metadata_of(scenario, Lane.WALL, run_folder.write_config(scenario)),
            "bus",
            setup.ticks,
            setup.bus.period_us,
        )
        words = [sys.executable, "-m", "hil.cli", "plant", str(folder / "endurance.toml")]
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as plant:
            try:
                assert plant.stdout is not None
                assert "pre-operational" in plant.stdout.readline()
                rig = _controlled(recorder, setup, plant.pid)
            finally:
                plant.terminate()
    notes = recorder.notes[: recorder.count]
    result = {
        "minutes": minutes,
        "bus": bus,
        "period_us": setup.bus.period_us,
        "ticks": recorder.ticks,
        "closed_share": recorder.closed_ticks / max(1, recorder.ticks),
        "skipped_ticks": recorder.skipped_ticks,
        "faults": rig.controller.faults,
        "clears": recorder.clears,
        "cleared_s": np.flatnonzero(notes[:, 5]).tolist(),
        "machine": machine,
        "own_kb": {name: notes[:, place].tolist() for place, name in enumerate(WHO)},
        "allocated_blocks": notes[:, 3].tolist(),
        "traced_bytes": notes[:, 4].tolist(),
    }
    return result | judged(result)


def _controlled(recorder: Witness, setup: Any, plant_pid: int) -> WallRig:
    with Ending() as ending:
        rig = WallRig(setup, recorder, ending)
        recorder.watch(plant_pid, rig)
        try:
            print(rig.go_real_time(), file=sys.stderr)
            tracemalloc.start()
            settle_memory()
            rig.start()
            rig.run()
        except Ended:
            print("ended from outside: what was seen until then", file=sys.stderr)
        finally:
            rig.close()
            tracemalloc.stop()
            leave_real_time()
            recorder.close()
    return rig


def judged(result: dict[str, Any]) -> dict[str, Any]:
    """By how much each has grown since the warm-up, its second half against its first, and whether that is nothing;
    what came with a fault and its clear is left out, and told by itself.
    """
    seconds = len(result["allocated_blocks"])
    begin = int(min(WARM_UP_MAX_S, WARM_UP_SHARE * seconds))
    cleared = [s for s in result["cleared_s"] if s >= begin]

    def grown(values: list[int]) -> float:
        kept = loop_alone(values, result["cleared_s"])[begin:]
        half = len(kept) // 2
        return float(np.median(kept[half:]) - np.median(kept[:half])) if half else float("nan")

    growth = {f"{name}_kb": grown(values) for name, values in result["own_kb"].items()}
    growth |= {"blocks": grown(result["allocated_blocks"]), "traced_kb": grown(result["traced_bytes"]) / 1000}
    limits = dict.fromkeys((f"{name}_kb" for name in WHO), GROWTH_MAX_KB)
    limits |= {"blocks": GROWTH_MAX_BLOCKS, "traced_kb": GROWTH_MAX_TRACED_KB}
    ok = all(abs(growth[name]) <= limit for name, limit in limits.items()) and result["closed_share"] > 0.9
    traced = np.array(result["traced_bytes"][begin:])
    alone = loop_alone(result["traced_bytes"], result["cleared_s"])[begin:]
    of_faults = (traced[-1] - traced[0]) - (alone[-1] - alone[0])
    return {
        "warm_up_s": begin, "growth": growth, "growth_max": limits, "ok": ok,
        "traced_kb_per_clear": float(of_faults) / 1000 / len(cleared) if cleared else None,
    }  # fmt: skip


def loop_alone(values: list[int], cleared_s: list[int]) -> Array:
    """The series without its steps in seconds in which a fault was decided, cleared, and the node started anew."""
    steps = np.diff(np.array(values, dtype=np.float64), prepend=values[0])
    for second in cleared_s:
        steps[second : second + RESTART_S] = 0.0
    return values[0] + np.cumsum(steps)


def draw(result: dict[str, Any], path: Path) -> None:
    """The picture: everything over time, from 0 up."""
    figure = sheet(7.2, 5.8, "Memory over ten minutes at rate, the garbage collector off")
    above, middle, below = figure.subplots(3, 1, sharex=True)
    t_min = np.arange(1, len(result["allocated_blocks"]) + 1) / 60.0
    for name, colour in zip(WHO, (BLUE, VERMILION, FAINT), strict=True):
        above.plot(t_min, np.array(result["own_kb"][name]) / 1000, color=colour, label=name)
    dress(above, "", "own memory (MB)")
    legend(above, columns=3)
    middle.plot(t_min, np.array(result["traced_bytes"]) / 1000, color=BLUE, label="what Python has allocated")
    dress(middle, "", "tracemalloc (kB)")
    legend(middle)
    blocks = np.array(result["allocated_blocks"])
    alone = loop_alone(result["allocated_blocks"], result["cleared_s"])
    for kept, style, name in ((blocks, ":", "with what faults leave"), (alone, "-", "of the loop alone")):
        label = f"since the warm-up, {name}"
        below.plot(t_min, kept - kept[result["warm_up_s"]], style, color=VERMILION, label=label)
    for n, second in enumerate(result["cleared_s"]):
        below.axvline(second / 60.0, ymax=0.7, color=ORANGE, lw=0.8, zorder=0, label="a fault" if n == 0 else None)
    dress(below, "minutes; dashed: end of the warm-up", "blocks of Python")
    legend(below, "upper left", columns=2)
    for axes in (above, middle, below):
        axes.set_ylim(min(0.0, axes.get_ylim()[0]), 1.35 * axes.get_ylim()[1])
        axes.axvline(result["warm_up_s"] / 60.0, ymax=0.7, color=MUTED, lw=0.8, ls="--")
    save(figure, path)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--bus", default="unix_2k")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    begin_s = time.monotonic()
    result = run(arguments.minutes, arguments.bus)
    arguments.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    draw(result, arguments.out.with_suffix(".png"))
    growth = ", ".join(f"{name} {value:+.1f}" for name, value in result["growth"].items())
    print(
        f"{result['ticks']} ticks in {time.monotonic() - begin_s:.0f} s, loop closed in "
        f"{100 * result['closed_share']:.1f} % of them; grown since second {result['warm_up_s']}: {growth}"
    )
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
