"""The native loop beside Python's, at 5 kHz on a bus among processes, in turn, with one plant's process for both."""

import dataclasses
import re
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.bench.rigs.figure import Figure
from hil.bench.rigs.running import running
from hil.native.program import compiled
from hil.runs.at_rate import RanAtRate, run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import Scenario, load_scenario
from hil.studies.latency import read_cyclictest, start_cyclictest
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.config.files import write_toml
from pkxyz_ctrl.io.clocks import percentile_us

TURNS, SECONDS = 3, 4.0
BUS = "unix_5k"
_NEVER = -1
_OF_LATENESS = (
    "stale", "sequence", "innovation", "residual", "unexplained_force", "saturation", "overrun", "slew",
)  # fmt: skip
_LINE = re.compile(r"\((\d+)\.(\d{6})\) \S+ ([0-9A-F]+)#")


class _Seen(NamedTuple):
    """Of one loop, all turns together."""

    answer_us: NDArray[np.int64]
    """(n,) from the sense frame on the bus to the drive frame handed over"""
    missed: int
    lateness_us: NDArray[np.int64]
    """wake-ups by whole us of lateness"""


def native() -> list[Figure]:
    """Times by the clock. A loop that misses ticks goes on: the monitors of lateness are off."""
    with tempfile.TemporaryDirectory(prefix="pkxyz-bench-") as name:
        folder = Path(name)
        scenario = _patient(folder)
        period_us = scenario.bus.period_us
        program, cyclictest = compiled(), shutil.which("cyclictest")
        ran: dict[str, list[tuple[RanAtRate, NDArray[np.int64]]]] = {"python": [], "native": []}
        bare = np.zeros(0, np.int64)
        with running("plant", "raster", "--bus", str(folder / "bus.toml")):
            for turn in range(TURNS):
                for loop, by in (("python", None), ("native", program)):
                    beside = start_cyclictest(cyclictest if by is not None else None, period_us, SECONDS)
                    run = RunFolder(folder / f"{loop}{turn}")
                    ran[loop].append((run_into(run, scenario, lambda words: None, program=by), answers_us(run.frames)))
                    if beside is not None and (histogram := read_cyclictest(beside.communicate()[0])) is not None:
                        bare = _added(bare, np.array(histogram))
    python, by_native = _seen(ran["python"]), _seen(ran["native"])
    return [*_answers(python, by_native), _missed(python, by_native), *_lateness(by_native, bare)]


def answers_us(frames: Path) -> NDArray[np.int64]:
    """(n,) from each sense frame of a log to the drive frame that is the next of the two, in us."""
    found, sensed_us = [], -1
    sense, drive = f"{cob_id.SENSE_BASE + 10:03X}", f"{cob_id.drive(10, 2):03X}"
    for line in frames.read_text(encoding="ascii").splitlines():
        if (match := _LINE.match(line)) is None:
            continue
        t_us = int(match[1]) * 1_000_000 + int(match[2])
        if match[3] == sense:
            sensed_us = t_us
        elif match[3] == drive and sensed_us >= 0:
            found.append(t_us - sensed_us)
            sensed_us = -1
    return np.array(found, np.int64)


def _answers(python: _Seen, by_native: _Seen) -> list[Figure]:
    figures = []
    for share, name, target in ((50.0, "p50", 0.1), (99.9, "p99_9", 0.2)):
        of_python, of_native = (float(np.percentile(seen.answer_us, share)) for seen in (python, by_native))
        detail = (
            f"from the sense frame on the bus to the drive frame out: {of_native:g} us, Python's loop {of_python:g}"
        )
        figures.append(Figure(f"native.answer_{name}", of_native / of_python, "x", target, "at most", detail=detail))
    return figures


def _missed(python: _Seen, by_native: _Seen) -> Figure:
    detail = f"missed ticks: {by_native.missed}, Python's loop {python.missed}, in {TURNS * SECONDS:g} s each"
    return Figure("native.missed", by_native.missed / max(1, python.missed), "x", 0.1, "at most", detail=detail)


def _lateness(by_native: _Seen, bare: NDArray[np.int64]) -> list[Figure]:
    late_us = percentile_us(by_native.lateness_us.tolist(), 0.999)
    if not len(bare):
        return [Figure("native.late", late_us, "us", detail="p99.9 of its wake-ups; cyclictest is not on the PATH")]
    bare_us = percentile_us(bare.tolist(), 0.999)
    detail = f"lateness of its wake-ups at p99.9: {late_us} us, cyclictest beside it {bare_us} us"
    return [Figure("native.late", late_us / max(1, bare_us), "x", 1.2, "at most", detail=detail)]


def _seen(ran: list[tuple[RanAtRate, NDArray[np.int64]]]) -> _Seen:
    lateness = np.zeros(0, np.int64)
    for end, _ in ran:
        lateness = _added(lateness, np.array(end.lateness_us))
    return _Seen(
        np.concatenate([a for _, a in ran]), sum(end.summary.loop.missed_ticks or 0 for end, _ in ran), lateness
    )


def _added(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    return a + b if len(a) else b.astype(np.int64)


def _patient(folder: Path) -> Scenario:
    """The raster on the bus of the bench, on a channel of its own, for so long; late ticks end nothing."""
    scenario = load_scenario("raster", bus=BUS)
    bus, law = scenario.bus.model_dump(exclude_none=True), scenario.controller.model_dump(exclude_none=True)
    bus["can"]["channel"] = str(folder / "bus")
    for monitor in (
        "stale",
        "sequence",
        "innovation",
        "residual",
        "unexplained_force",
        "saturation",
        "overrun",
        "slew",
    ):
        law["monitors"][f"{monitor}_count"] = _NEVER
    write_toml(bus, folder / "bus.toml")
    write_toml(law, folder / "law.toml")
    loaded = load_scenario("raster", bus=str(folder / "bus.toml"), controller=str(folder / "law.toml"))
    return dataclasses.replace(loaded, config=loaded.config.model_copy(update={"duration_s": SECONDS}))
