"""The native loop beside Python's, at 5 kHz on a bus among processes, in turn, with one plant's process for both."""

import dataclasses
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

from hil.bench.rigs.figure import Figure
from hil.bench.rigs.running import running
from hil.native.program import compiled
from hil.recording.recording import Recording
from hil.runs.at_rate import RanAtRate, run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import Scenario, load_scenario
from hil.studies.latency import read_cyclictest, start_cyclictest
from pkxyz_ctrl.config.files import write_toml
from pkxyz_ctrl.io.clocks import percentile_us

TURNS, SECONDS = 5, 4.0
BUS = "unix_5k"
_NEVER = -1
_OF_LATENESS = (
    "stale", "sequence", "innovation", "residual", "unexplained_force", "saturation", "overrun", "slew",
)  # fmt: skip


class _Seen(NamedTuple):
    """Of one loop, all turns together."""

    answer_us: list[list[int]]
    """by whole us from a sense frame read to the drive frame handed over, by turn"""
    given_up: list[int]
    """ticks that the loop itself was too late for, by turn"""
    lateness_us: list[int]
    """wake-ups by whole us of lateness"""


def native() -> list[Figure]:
    """Times by the clock. A loop that misses ticks goes on: the monitors of lateness are off."""
    with tempfile.TemporaryDirectory(prefix="pkxyz-bench-") as name:
        folder = Path(name)
        scenario = _patient(folder)
        period_us = scenario.bus.period_us
        program, cyclictest = compiled(), shutil.which("cyclictest")
        ran: dict[str, list[tuple[RanAtRate, int]]] = {"python": [], "native": []}
        bare: list[list[int]] = []
        with running("plant", "raster", "--bus", str(folder / "bus.toml")):
            for turn in range(TURNS):
                for loop, by in (("python", None), ("native", program)):
                    run = RunFolder(folder / f"{loop}{turn}")
                    ran[loop].append((run_into(run, scenario, lambda words: None, program=by), given_up(run)))
                alone = start_cyclictest(cyclictest, period_us, SECONDS)
                if alone is not None and (histogram := read_cyclictest(alone.communicate()[0])) is not None:
                    bare.append(histogram)
    python, by_native = _seen(ran["python"]), _seen(ran["native"])
    return [*_answers(python, by_native), _missed(python, by_native), *_lateness(by_native, bare)]


def given_up(run: RunFolder) -> int:
    """Ticks that the loop of a run skipped, as it was too late for them; not those without an answer."""
    return sum(int(rows["overrun"].sum()) for rows in Recording.open(run.recording).rows(["overrun"]))


def _answers(python: _Seen, by_native: _Seen) -> list[Figure]:
    """By the turn in the middle, as ``_missed``."""
    figures = []
    for share, name, target in ((0.5, "p50", 0.1), (0.999, "p99_9", 0.2)):
        of_python, of_native = (
            [round(within_us(turn, share), 1) for turn in seen.answer_us] for seen in (python, by_native)
        )  # fmt: skip
        detail = (
            f"from a sense frame read to the drive frame handed over, in the middle of {TURNS} turns: "
            f"{median(of_native)} us, Python's loop {median(of_python)} us ({_listed(of_native)}; {_listed(of_python)})"
        )
        ratio = median(of_native) / max(1.0, median(of_python))  # of none: 0 over 1
        figures.append(Figure(f"native.answer_{name}", ratio, "x", target, "at most", detail=detail))
    return figures


def within_us(histogram: list[int], share: float) -> float:
    """The time in us that a share 0..1 is below, where those of a whole microsecond are spread evenly over it."""
    wanted, below = share * sum(histogram), 0
    for whole_us, count in enumerate(histogram):
        if count and below + count >= wanted:
            return whole_us + (wanted - below) / count
        below += count
    return 0.0


def _missed(python: _Seen, by_native: _Seen) -> Figure:
    """By the turn in the middle: a machine that stands still for a while spoils one."""
    detail = (
        f"ticks that it was too late for in {TURNS} turns of {SECONDS:g} s: {_listed(by_native.given_up)}; "
        f"Python's loop {_listed(python.given_up)}"
    )
    ratio = median(by_native.given_up) / max(1.0, median(python.given_up))
    return Figure("native.missed", ratio, "x", 0.1, "at most", detail=detail)


def _listed(counts: Sequence[float]) -> str:
    return ", ".join(map(str, counts))


def _lateness(by_native: _Seen, bare: list[list[int]]) -> list[Figure]:
    late_us = percentile_us(by_native.lateness_us, 0.999)
    if not bare:
        return [Figure("native.late", late_us, "us", detail="p99.9 of its wake-ups; cyclictest is not on the PATH")]
    bare_us = percentile_us(_added(bare), 0.999)
    detail = f"lateness of its wake-ups at p99.9: {late_us} us, cyclictest in turn {bare_us} us"
    return [Figure("native.late", late_us / max(1, bare_us), "x", 1.2, "at most", detail=detail)]


def _seen(ran: list[tuple[RanAtRate, int]]) -> _Seen:
    lateness = _added([end.lateness_us for end, _ in ran])
    return _Seen([end.answer_us for end, _ in ran], [count for _, count in ran], lateness)


def _added(histograms: list[list[int]]) -> list[int]:
    """All in one."""
    return [sum(counts) for counts in zip(*histograms, strict=True)]


def _patient(folder: Path) -> Scenario:
    """The raster on the bus of the bench, on a channel of its own, for so long; late ticks end nothing."""
    scenario = load_scenario("raster", bus=BUS)
    bus, law = scenario.bus.model_dump(exclude_none=True), scenario.controller.model_dump(exclude_none=True)
    bus["can"]["channel"] = str(folder / "bus")
    for monitor in _OF_LATENESS:
        law["monitors"][f"{monitor}_count"] = _NEVER
    write_toml(bus, folder / "bus.toml")
    write_toml(law, folder / "law.toml")
    loaded = load_scenario("raster", bus=str(folder / "bus.toml"), controller=str(folder / "law.toml"))
    return dataclasses.replace(loaded, config=loaded.config.model_copy(update={"duration_s": SECONDS}))
