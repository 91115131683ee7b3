"""A long run in lockstep under random faults: what is left of it, and whether anything was lost, grew or broke.

One rig for the whole time. Its rows go to a recording a minute, which is closed, read again and checked before the
next; then it is deleted, unless it is to be kept: half an hour is 3 GB. Most stay journals, as after a kill: turning
them into Parquet is a tenth of the time.
"""

import bisect
import dataclasses
import random
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.faults.fault import Fault, parse
from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.recording.journal import JournalReader
from hil.recording.recording import Recording, RecordingWriter, journal_of
from hil.runs.scenario import Scenario, load_scenario
from hil.studies.faults.matrix import CASES, NODE_MS
from hil.studies.faults.outcome import DISCHARGED_V, RISE_V, largest_rise_v, largest_step_v
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.safety.modes import MAY_ENERGISE, Mode
from pkxyz_ctrl.safety.trips import Trip

SCENARIO = "faults"
CLEAR_S = 0.02
AFTER_US = 50_400
"""From the end of a fault to the last decision that it may lead to: the longest time-out, that of a heartbeat, and two
periods until it is seen and told. What falls into a homing shows when the zero is first used that was found then.
"""
_FIRST_USE_US = 100_000  # from the end of a homing: the scan has left the rest pose by then
_RINGS_US = 30_000  # or so shortly before it that the stage still rings: three time constants at 619 Hz and Q 20
_GAP_S = (0.15, 0.7)  # between the beginnings of faults: some hit a scan, some a start-up, some a homing
_LASTS_S = (0.0005, 0.06)
_QUIET_S = 0.05  # at the end, so that the last one is not cut off
_LEFT_OUT = ("controller:killed", "bus.drive:forged")  # would end the run; has a voltage of its own
_ROWS_EACH = 300_000  # of one recording: a minute at 5 kHz
_PARQUET_EACH = 64  # one in so many recordings that are not kept, the first of each soak
_MEMORY_OF = 16  # recordings at either end: what Parquet takes is given back later


@dataclass
class Soaked:
    """What came of it."""

    seed: int
    law: str
    ticks: int = 0
    recorded_ticks: int = 0
    """read back from the recordings, in one unbroken sequence"""
    interrupted: bool = False
    """by the keyboard: the figures are those of the time until then"""
    faults: int = 0
    faults_by_case: dict[str, int] = field(default_factory=dict)
    """... of each case of the matrix"""
    undecided: dict[str, int] = field(default_factory=dict)
    """those that led to no decision: right where a fault is short or small, or meets what is stopped already"""
    decisions: int = 0
    returns: int = 0
    """how often it was tracking again after a fault decision"""
    reasons: dict[str, int] = field(default_factory=dict)
    voltage_max_v: float = 0.0
    """of combs that do what the node tells them; so are the next three"""
    slew_max_v: float = 0.0
    """most that a comb's voltage changed in a tick, releases to 0 V excepted"""
    rise_max_v: float = 0.0
    """most that it rose in a tick while no voltage was allowed"""
    zero_ticks: int = 0
    """longest that a comb was above 0 V after the end of a mode with voltages"""
    misled: int = 0
    """decisions later than any fault's own, excused since one had fallen into the homing before"""
    unprovoked: int = 0
    """decisions without a fault that could have led to them"""
    latest_us: int = 0
    """longest from the end of the last fault to a decision"""
    damaged: bool = False
    """fingers snapped or the mechanism broken"""
    memory_mb: list[float] = field(default_factory=list)
    """resident, after each recording"""
    minutes_each: float = 0.0
    """stage time of a recording; the last one may be shorter"""
    faults_each: list[int] = field(default_factory=list)
    """faults that began in each recording, and likewise:"""
    decisions_each: list[int] = field(default_factory=list)
    returns_each: list[int] = field(default_factory=list)
    realtime_factor: float = 0.0
    problems: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether nothing was lost, nothing broke and nothing grew."""
        return not self.problems


def soaked_scenario(law: str) -> Scenario:
    """The scan that is soaked, under a law of ``configs/controllers`` or of a file. Raises ``ConfigError``."""
    return load_scenario(SCENARIO, controller=law)


def random_faults(duration_s: float, seed: int) -> tuple[Fault, ...]:
    """Faults from power-on to shortly before the end: every kind of the matrix but two."""
    dice = random.Random(seed)
    texts = [case.text for case in CASES if case.text not in _LEFT_OUT]
    faults = []
    at_s = 0.1
    while at_s < duration_s - _QUIET_S - _LASTS_S[1]:
        head, comma, rest = dice.choice(texts).partition(",")
        faults.append(parse(f"{head}@{at_s:.6f}+{dice.uniform(*_LASTS_S):.6f}{comma}{rest}"))
        at_s += dice.uniform(*_GAP_S)
    return tuple(faults)


def soak(
    duration_s: float,
    seed: int,
    scenario: Scenario,
    folder: Path,
    *,
    keep: bool = False,
    rows_each: int = _ROWS_EACH,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Soaked:
    """Run for ``duration_s`` of stage time, or until Ctrl-C; ``scenario`` names law and device, ``seed`` that of noise
    and faults. Raises ``RecordingError`` when the disk fails.
    """
    law = scenario.controller.name
    setup = dataclasses.replace(
        scenario.setup(), seed=seed, duration_s=duration_s, clear_s=CLEAR_S, faults=random_faults(duration_s, seed)
    )
    rig = LockstepRig(setup, controller=NotingController)
    soaked = Soaked(seed, law, setup.ticks, faults=len(setup.faults))
    soaked.minutes_each = rows_each * setup.bus.period_s / 60.0
    log = _Log(soaked, rig, folder, rows_each, keep)
    blocks = Blocks(setup.trajectory, setup.bus.period_us, setup.ticks, log.take, on_progress)
    begin_s = time.perf_counter()
    try:
        rig.run(blocks)
    except KeyboardInterrupt:
        soaked.interrupted = True
        soaked.ticks = blocks.done
        soaked.faults = sum(f.at_us < blocks.done * setup.bus.period_us for f in setup.faults)
    log.close()
    begun = [_case_of(fault) for fault in setup.faults[: soaked.faults]]
    soaked.faults_by_case = dict(Counter(begun).most_common())
    soaked.undecided = dict(Counter(case for n, case in enumerate(begun) if n not in log.decided).most_common())
    soaked.realtime_factor = blocks.done * setup.bus.period_s / (time.perf_counter() - begin_s)
    _judge(soaked, setup)
    return soaked


def _case_of(fault: Fault) -> str:
    """As the matrix has it, without its time."""
    head, _, rest = str(fault).partition("@")
    return ",".join((head, *rest.split(",")[1:]))


class Decided(NamedTuple):
    """A fault decision."""

    t_us: int
    """the end of its tick, on the bus's clock"""
    age_us: int
    """how long ago came what it is for: an emergency of the node's may wait for the end of a start-up; else 0"""


class NotingController(Controller):
    """Keeps its fault decisions, until somebody takes them."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.decided: list[Decided] = []

    def compute(self, reference: NDArray[np.void], overrun: int) -> None:
        """As ever."""
        before = self.mode
        super().compute(reference, overrun)
        if self.mode == Mode.FAULT != before:
            row, begun_us = self.memory["row"][0], int(self.exchange["begun_us"][0])
            came_us = int(self.exchange["driver"]["emergency_us"][0, 0])
            age_us = begun_us + self.period_us - came_us if int(row["trips"]) == Trip.NODE_EMERGENCY else 0
            self.decided.append(Decided(begun_us + self.period_us, age_us))


class _Log:
    """Takes the rows: into recordings that are checked one by one, and into the figures."""

    def __init__(self, soaked: Soaked, rig: LockstepRig, folder: Path, rows_each: int, keep: bool) -> None:
        self._soaked, self._rig, self._folder, self._rows_each, self._keep = soaked, rig, folder, rows_each, keep
        assert isinstance(rig.controller, NotingController)
        self._controller = rig.controller
        self._reasons: Counter[str] = Counter()
        self._writer: RecordingWriter | None = None
        self._last_mode = int(Mode.IDLE)
        self._skipped, self._homing_us = 0, (0, 0)
        self._voltages = _Voltages(soaked, rig.setup)
        self._begins_us = [f.at_us for f in rig.setup.faults]
        self._ends_us = [f.end_us or f.at_us for f in rig.setup.faults]
        self._parts = 0
        self.decided: set[int] = set()
        """which of the faults led to a decision"""

    def take(self, rows: NDArray[np.void]) -> None:
        if self._writer is None:
            self._parts += 1
            meta = {"scenario": "soak", "part": self._parts, "seed": self._soaked.seed}
            self._writer = RecordingWriter(self._folder / f"soak-{self._parts:03d}.parquet", meta)
        self._writer.write(rows)
        self._observe(rows)
        if self._writer.ticks >= self._rows_each:
            self.close()

    def close(self) -> None:
        """Close the present recording, and read it again."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        ticks = _read_again(writer, as_parquet=self._keep or self._parts % _PARQUET_EACH == 1)
        expected = np.arange(self._soaked.recorded_ticks, self._soaked.recorded_ticks + len(ticks))
        if not np.array_equal(ticks, expected):
            self._soaked.problems.append(f"{writer.path.name}: its ticks are not {expected[0]} to {expected[-1]}")
        self._soaked.recorded_ticks += len(ticks)
        if not self._keep:
            writer.path.unlink(missing_ok=True)
            journal_of(writer.path).unlink(missing_ok=True)
        soaked, period_us = self._soaked, self._rig.setup.bus.period_us
        soaked.memory_mb.append(_resident_mb())
        began = sum(f.at_us < soaked.recorded_ticks * period_us for f in self._rig.setup.faults)
        soaked.faults_each.append(began - sum(soaked.faults_each))
        soaked.decisions_each.append(soaked.decisions - sum(soaked.decisions_each))
        soaked.returns_each.append(soaked.returns - sum(soaked.returns_each))

    def _observe(self, rows: NDArray[np.void]) -> None:
        soaked = self._soaked
        mode = np.concatenate([[self._last_mode], rows["mode"]])
        entered = np.flatnonzero((mode[1:] == Mode.FAULT) & (mode[:-1] != Mode.FAULT))
        for row in rows[entered]:
            self._reasons.update(str(trip.name) for trip in Trip if trip & int(row["trips"]))
        noted = self._controller.decided
        for decided, homing_us in zip(noted, self._homings_us(rows, mode, entered), strict=False):
            self._explain(decided, homing_us)
        if len(noted) != len(entered):
            soaked.problems.append(f"{len(noted)} decisions in a block whose rows show {len(entered)}")
        noted.clear()
        soaked.decisions += len(entered)
        soaked.returns += int(np.count_nonzero((mode[1:] == Mode.TRACKING) & (mode[:-1] == Mode.ENABLED)))
        soaked.reasons = dict(self._reasons.most_common())
        self._voltages.look_at(rows)
        state = self._rig.plant.plant.state[0]
        soaked.damaged |= bool(state["broken"] or state["held"].any())
        self._rig.controller.faults.clear()  # counted; the words of a thousand faults are of no use
        self._last_mode = int(mode[-1])

    def _homings_us(
        self, rows: NDArray[np.void], mode: NDArray[np.int64], at: NDArray[np.intp]
    ) -> list[tuple[int, int]]:
        """When the latest homing before each of these rows of a block began and ended; ``mode`` has one more."""
        skipped = self._skipped + np.cumsum(rows["overrun"])
        t_us = (rows["tick"] + skipped) * self._rig.setup.bus.period_us
        self._skipped = int(skipped[-1])
        is_homing, found = mode == Mode.HOMING, []
        begun = np.flatnonzero(is_homing[1:] & ~is_homing[:-1])
        ended = np.flatnonzero(~is_homing[1:] & is_homing[:-1])
        for row in (*at, len(rows) - 1):
            begin_us, end_us = self._homing_us
            if len(before := begun[begun <= row]):
                begin_us = int(t_us[before[-1]])
            if len(before := ended[ended <= row]):
                end_us = int(t_us[before[-1]])
            found.append((begin_us, end_us))
        self._homing_us = found.pop()
        return found

    def _explain(self, decided: Decided, homing_us: tuple[int, int]) -> None:
        """A decision has to follow a fault: itself, or the emergency that it is for and that came before; or else there
        was one while the zero was found.
        """
        assert self._rig.injection is not None
        t_us = decided.t_us - decided.age_us - self._rig.injection.origin_us
        last = bisect.bisect_right(self._begins_us, t_us) - 1
        since_us = t_us - (self._ends_us[last] if last >= 0 else 0)
        self._soaked.latest_us = max(self._soaked.latest_us, since_us)
        in_homing = bisect.bisect_left(self._begins_us, homing_us[1]) - 1
        misled = in_homing >= 0 and self._ends_us[in_homing] + _RINGS_US > homing_us[0]
        misled = misled and t_us <= homing_us[1] + _FIRST_USE_US
        if last >= 0 and since_us <= AFTER_US:
            self.decided.add(last)
        elif misled:
            self._soaked.misled += 1
            self.decided.add(in_homing)
        else:
            self._soaked.unprovoked += 1


def _read_again(writer: RecordingWriter, *, as_parquet: bool) -> NDArray[np.int64]:
    """(n,): ticks of a recording that is closed now."""
    if as_parquet:
        writer.close()
        return Recording.open(writer.path)["tick"]
    writer.leave()
    return JournalReader(journal_of(writer.path)).mapped()["tick"].copy()


class _Voltages:
    """Holds the combs' voltages to what is allowed, block by block. A comb whose amplifier channel does not obey is not
    asked, from the beginning of that fault to a few ticks after it.
    """

    _AFTER = 4  # ticks: the rest of a release that a fault has held up

    def __init__(self, soaked: Soaked, setup: Setup) -> None:
        self._soaked, self._period_us = soaked, setup.bus.period_us
        disobedient = [f for f in setup.faults if f.family == "amplifier" and f.kind != "trip"]
        after_us = self._AFTER * self._period_us
        times = [(f.at_us - self._period_us, (f.end_us or 0) + after_us, f.channel) for f in disobedient]
        self._disobedient = deque(times)  # in the order of their beginnings, less those that are over
        self._volts: NDArray[np.float64] = np.zeros((3, 3))  # the last ticks of the block before
        self._obeys: NDArray[np.bool_] = np.ones((3, 3), bool)
        self._forbidden: NDArray[np.bool_] = np.ones(3, bool)
        self._forbidden_for = 3
        self._skipped = 0  # ticks that the controller missed: the bus has gone on meanwhile

    def look_at(self, rows: NDArray[np.void]) -> None:
        """Take the next rows of the run."""
        soaked = self._soaked
        volts = np.concatenate([self._volts, rows["comb_voltage_v"]])
        skipped = self._skipped + np.cumsum(rows["overrun"])
        self._skipped = int(skipped[-1])
        obeys = np.concatenate([self._obeys, self._obedience(rows["tick"] + skipped)])
        forbidden = np.concatenate([self._forbidden, MAY_ENERGISE[rows["mode"]] == 0])
        soaked.voltage_max_v = max(soaked.voltage_max_v, float(volts[obeys].max(initial=0.0)))
        asked = np.where(obeys, volts, np.nan)  # and so are the steps to and from there: none
        soaked.slew_max_v = max(soaked.slew_max_v, largest_step_v(asked[:-1], asked[-1]))
        soaked.rise_max_v = max(soaked.rise_max_v, largest_rise_v(asked, forbidden))
        ticks = np.arange(1, len(forbidden) - 2)
        allowed = np.maximum.accumulate(np.where(forbidden[3:], -self._forbidden_for, ticks))
        lasted = np.where(forbidden[3:], ticks - allowed, 0)  # so long none has been allowed
        charged = ((volts[3:] >= DISCHARGED_V) & obeys[3:]).any(axis=1)
        soaked.zero_ticks = max(soaked.zero_ticks, int(lasted[charged].max(initial=0)))
        self._forbidden_for = int(lasted[-1])
        self._volts, self._obeys, self._forbidden = volts[-3:].copy(), obeys[-3:], forbidden[-3:]

    def _obedience(self, ticks: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(n, 3), for ticks of the bus's time."""
        obeys, t_us = np.ones((len(ticks), 3), bool), ticks * self._period_us
        while self._disobedient and self._disobedient[0][1] < t_us[0]:
            self._disobedient.popleft()
        for begin_us, end_us, channel in self._disobedient:
            if begin_us > t_us[-1]:
                break
            obeys[(begin_us <= t_us) & (t_us <= end_us), channel] = False
        return obeys


def _judge(soaked: Soaked, setup: Setup) -> None:
    problems, limits = soaked.problems, setup.controller.limits
    voltage_max_v, step_max_v = limits.voltage_max_v, limits.slew_max_v_per_s * setup.bus.period_s
    zero_ticks_max = round(NODE_MS * 1e3 / setup.bus.period_us) + 1
    if soaked.recorded_ticks != soaked.ticks:
        problems.append(f"{soaked.recorded_ticks} ticks recorded of {soaked.ticks}")
    if soaked.damaged:
        problems.append("the stage is damaged")
    if soaked.voltage_max_v > voltage_max_v * (1 + 1e-9):
        problems.append(f"{soaked.voltage_max_v:.1f} V at a comb")
    if soaked.slew_max_v > step_max_v * (1 + 1e-3):
        problems.append(f"a comb's voltage changed by {soaked.slew_max_v:.1f} V in a tick")
    if soaked.rise_max_v > RISE_V:
        problems.append(f"a comb's voltage rose by {soaked.rise_max_v:.1f} V while none was allowed")
    if soaked.zero_ticks > zero_ticks_max:
        problems.append(f"a voltage {soaked.zero_ticks} ticks after the end of a mode with voltages")
    if soaked.unprovoked:
        problems.append(f"{soaked.unprovoked} decisions without a fault in the {AFTER_US // 1000} ms before")
    if soaked.decisions == 0 or soaked.returns == 0:
        problems.append("no fault was decided, or none recovered from")
    if len(soaked.memory_mb) > 4:
        some = min(_MEMORY_OF, len(soaked.memory_mb) // 2)
        early, late = min(soaked.memory_mb[1 : 1 + some]), min(soaked.memory_mb[-some:])
        if late > early + 20.0:
            problems.append(f"memory grew from {early:.0f} to {late:.0f} MB")


def _resident_mb() -> float:
    """Resident memory of this process, Linux."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


def as_json(soaked: Soaked) -> dict[str, Any]:
    """Plain data."""
    return dataclasses.asdict(soaked) | {"ok": soaked.ok}
