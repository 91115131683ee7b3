"""One case of the matrix run against one law, and what came of it."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from hil.studies.faults.matrix import CLEAR_S, USUAL_PERIOD_US, Case
from pkxyz_ctrl.loop.controller import StartUpError
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, MAY_ENERGISE, Mode
from pkxyz_ctrl.safety.trips import Trip

SCENARIO = "faults"
DISCHARGED_V = 1.0
RISE_V = 0.1
"""Less than any step that was ever sent; offsets of some counts may come with the end of a fault."""
_START_UP_TICKS = 150  # after a clear: an SDO exchange a tick, and 0 V for a while; a slow bus needs the longer for it
_ZERO_TICKS = 2  # from the tick of the decision, whose frame acts at the next SYNC


@dataclass(frozen=True)
class Outcome:
    """What came of one fault under one law. Voltages are those that were at the combs."""

    law: str
    case: str
    reason: tuple[str, ...]
    """names of the trips that were latched; empty if nothing was noticed"""
    ticks: int | None
    """from the beginning of the fault to the decision; None: not noticed"""
    voltage_max_v: float
    slew_max_v: float
    """most that the voltage of a comb that obeys changed in a tick of the whole run, releases to 0 V excepted"""
    rise_max_v: float
    """most that the voltage of a comb that obeys rose in a tick while none was allowed"""
    zero_ms: float | None
    """from the decision, or from the end of the controller, to 0 V at all combs that obey; None: they stayed driven"""
    excursion_um: float
    """furthest that a stroke was from where it should have been while the loop was closed"""
    events: tuple[str, ...]
    """what happened to the stage: stop, pulled_in, broken"""
    recovered: bool | None
    """whether it was tracking again in the end, after the clear; None: there was nothing to recover from"""
    problems: tuple[str, ...]
    """what was not as it has to be; empty: the stage was saved, and everybody knows why"""

    @property
    def ok(self) -> bool:
        """Whether every bound of the case was kept."""
        return not self.problems


def setup_for(law: str, seed: int | None = None, bus: str | None = None) -> Setup:
    """The scan that is broken, under a law of ``configs/controllers`` or of a file, on a bus.

    Raises ``ConfigError``.
    """
    setup = load_scenario(SCENARIO, controller=law, seed=seed, bus=bus).setup()
    slower_s = max(0.0, setup.bus.period_s - USUAL_PERIOD_US * 1e-6)
    return dataclasses.replace(setup, duration_s=setup.duration_s + _START_UP_TICKS * slower_s)


def run_case(law: str, setup: Setup, case: Case) -> Outcome:
    """Run one case in the lockstep lane and judge it."""
    case = case.on(setup.bus.period_us)
    fault = case.fault
    run_setup = dataclasses.replace(setup, faults=(fault,), clear_s=CLEAR_S)
    vars(run_setup)["law"] = setup.law  # designed once
    blocks: list[NDArray[np.void]] = []
    rig = LockstepRig(run_setup)
    assert rig.injection is not None
    rig.injection.watched = []
    try:
        rig.run(
            Blocks(run_setup.trajectory, run_setup.bus.period_us, run_setup.ticks, lambda b: blocks.append(b.copy()),
                   lambda done, total: None)
        )  # fmt: skip
    except StartUpError as error:
        return Outcome(law, case.text, (), None, 0.0, 0.0, 0.0, 0.0, 0.0, (), None, (f"did not start: {error}",))
    return _judge(law, case, run_setup, rig, np.concatenate(blocks))


def _judge(law: str, case: Case, setup: Setup, rig: LockstepRig, rows: NDArray[np.void]) -> Outcome:
    period_us = setup.bus.period_us
    onset = case.fault.at_us // period_us
    decision = _decision(rows)
    trips = Trip(int(rows["trips"][decision])) if decision is not None else Trip(0)
    assert rig.injection is not None
    voltage = np.array(rig.injection.watched)  # at the end of each tick
    obeying = voltage[:, list(case.obeys)]
    forbidden = MAY_ENERGISE[rows["mode"][: len(voltage)]] == 0
    closed = np.flatnonzero(LOOP_CLOSED[rows["mode"][: len(rows) if decision is None else decision]])
    strokes = rows["stroke_m"][closed] - _strokes_of(setup, rows["reference_m"][closed])
    zero_ms = _zero_ms(case, rig, voltage, decision, period_us)
    released = decision is not None or bool(rig.injection and rig.injection.afterwards)
    recovered = bool(rows["mode"][-1] == Mode.TRACKING) if decision is not None else None
    outcome = Outcome(
        law=law,
        case=case.text,
        reason=tuple(str(t.name) for t in Trip if t & trips),
        ticks=None if decision is None else decision - onset,
        voltage_max_v=float(voltage.max()),
        slew_max_v=largest_step_v(obeying),
        rise_max_v=largest_rise_v(obeying, forbidden),
        zero_ms=zero_ms,
        excursion_um=float(np.abs(strokes).max()) * 1e6 if len(closed) else 0.0,
        events=tuple(sorted({e.kind for e in rig.plant.plant.events})),
        recovered=recovered,
        problems=(),
    )
    return dataclasses.replace(
        outcome,
        problems=(
            *_problems(case, setup, rows, outcome, onset, decision, released),
            *_problems_of_releases(case, setup, obeying, forbidden),
        ),
    )


def _decision(rows: NDArray[np.void]) -> int | None:
    """The tick of the first fault decision, which is that of FAULT or of the way down that ends there."""
    latched = np.flatnonzero(rows["mode"] == Mode.FAULT)
    if not len(latched):
        return None
    before = np.flatnonzero(rows["mode"][: latched[0]] != Mode.LANDING)
    return int(before[-1]) + 1 if len(before) else 0


def _problems(
    case: Case, setup: Setup, rows: NDArray[np.void], outcome: Outcome, onset: int, decision: int | None, released: bool
) -> list[str]:
    """Every bound that was not kept, in words."""
    limits = setup.controller.limits
    problems = []
    if decision is None:
        if case.reasons and not case.may_go_on:
            problems.append("was not noticed")
    else:
        if decision < onset:
            problems.append(f"a fault {onset - decision} ticks before anything was wrong")
        elif not case.reasons & Trip(int(rows["trips"][decision])):
            problems.append(f"latched {' and '.join(outcome.reason)}, which is not the cause")
        ends = 0 if case.lasts_s is None else round(case.lasts_s * 1e6) // setup.bus.period_us
        if decision - onset > case.within_ticks and not (case.may_go_on and decision - onset >= ends):
            problems.append(f"noticed after {decision - onset} ticks instead of {case.within_ticks}")
        problems += _problems_after(rows, decision)
        if not outcome.recovered and case.lasts_s is not None:
            problems.append("did not track again after the clear")
    if outcome.voltage_max_v > limits.voltage_max_v * (1 + 1e-9):
        problems.append(f"{outcome.voltage_max_v:.1f} V at a comb, beyond {limits.voltage_max_v:g} V")
    step_v = limits.slew_max_v_per_s * setup.bus.period_s
    if outcome.slew_max_v > step_v * (1 + 1e-3):
        problems.append(f"a step of {outcome.slew_max_v:.1f} V in a tick, beyond {step_v:g} V")
    if outcome.rise_max_v > RISE_V + case.forged_v:
        problems.append(f"a comb rose by {outcome.rise_max_v:.1f} V after the decision")
    allowed_ms = _allowed_ms(case, setup)
    if decision is not None and rows["mode"][decision] == Mode.LANDING:
        allowed_ms += float(setup.law["landing_ticks"][0]) * setup.bus.period_us * 1e-3
    if released and (outcome.zero_ms is None or outcome.zero_ms > allowed_ms + 1e-9):
        after = "never" if outcome.zero_ms is None else f"{outcome.zero_ms:g} ms"
        problems.append(f"0 V after {after}, not within {allowed_ms:g} ms")
    if {"pulled_in", "broken"} & set(outcome.events):
        problems.append(f"the stage is damaged: {', '.join(outcome.events)}")
    return problems


def _problems_after(rows: NDArray[np.void], decision: int) -> list[str]:
    """Whether it stayed latched, at 0 V commanded, until the clear."""
    decision += int(np.argmax(rows["mode"][decision:] == Mode.FAULT))
    cleared = np.flatnonzero(rows["mode"][decision:] != Mode.FAULT)
    until = decision + (int(cleared[0]) if len(cleared) else len(rows) - decision)
    problems = []
    if rows["drive_count"][MAY_ENERGISE[rows["mode"]] == 0].any():
        problems.append("a voltage was commanded in a mode that allows none")
    if len(cleared) and rows["mode"][until] != Mode.BOOT:
        problems.append(f"left FAULT for {Mode(int(rows['mode'][until])).name} without a clear")
    return problems


def largest_step_v(voltage: NDArray[np.float64], after: NDArray[np.float64] | None = None) -> float:
    """Most that a voltage changed in a tick. A release to 0 V does not count: it may come at once, from anywhere, and
    may be looked at in the middle of its fall. ``voltage`` (n, combs), NaN where a comb is not asked; ``after``
    (combs,): the voltages of the tick behind, where they are known.
    """
    steps = np.diff(voltage, axis=0)
    released = voltage[1:] < DISCHARGED_V
    last = released[-1:] if after is None else (after < DISCHARGED_V)[np.newaxis]
    falling = np.vstack([released[1:], last]) & (steps < 0)
    counted = np.abs(steps[~released & ~falling])
    return float(counted[~np.isnan(counted)].max(initial=0.0))


def largest_rise_v(voltage: NDArray[np.float64], forbidden: NDArray[np.bool_]) -> float:
    """Most that a voltage rose in a tick after two in which none was allowed, over the whole run. After the first, a
    SYNC that is late may be on its way that still applies what was sent before the decision.
    """
    steps = np.diff(voltage, axis=0)[1:]
    rises = steps[forbidden[:-2] & forbidden[1:-1] & forbidden[2:]]
    return float(rises[~np.isnan(rises)].max(initial=0.0))


def _allowed_ms(case: Case, setup: Setup) -> float:
    return case.discharged_within_ms or _ZERO_TICKS * setup.bus.period_us * 1e-3


def _problems_of_releases(
    case: Case, setup: Setup, voltage: NDArray[np.float64], forbidden: NDArray[np.bool_]
) -> list[str]:
    """Whether after each end of a mode with voltages, not only after the first, the combs were at 0 V in time, and
    stayed there until the next such mode, or to the end of the run.
    """
    edges = np.flatnonzero(np.diff(forbidden.astype(np.int8)))
    problems = []
    for begin in edges[forbidden[edges + 1]] + 1:
        later = edges[edges >= begin]
        end = int(later[0]) + 1 if len(later) else len(voltage)
        due = begin + round(_allowed_ms(case, setup) * 1e3 / setup.bus.period_us)
        beyond = (voltage[due:end] >= DISCHARGED_V + case.forged_v).any(axis=1)
        if beyond.any():
            at = due + int(np.flatnonzero(beyond)[-1])
            problems.append(f"{voltage[at].max():.1f} V at tick {at}, {at - begin} after the release at {begin}")
    return problems


def _zero_ms(
    case: Case, rig: LockstepRig, voltage: NDArray[np.float64], decision: int | None, period_us: int
) -> float | None:
    """How long after the decision all combs that obey were at 0 V; after the controller's end, if that was first."""
    obeys = list(case.obeys)
    if rig.injection is not None and rig.injection.afterwards:
        for look in rig.injection.afterwards:
            if max(np.array(look.comb_voltage_v)[obeys]) < DISCHARGED_V:
                return (look.t_us - case.fault.at_us) * 1e-3
        return None
    if decision is None:
        return None
    low = np.flatnonzero((voltage[decision:, obeys] < DISCHARGED_V).all(axis=1))
    return int(low[0]) * period_us * 1e-3 if len(low) else None


def _strokes_of(setup: Setup, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    from pkxyz_ctrl.stage import Stage

    return Stage(setup.stage).inverse_kinematics(position_m)


def as_json(outcome: Outcome) -> dict[str, Any]:
    """Plain data."""
    return dataclasses.asdict(outcome) | {"ok": outcome.ok}


__all__ = [
    "DISCHARGED_V",
    "RISE_V",
    "Outcome",
    "as_json",
    "largest_rise_v",
    "largest_step_v",
    "run_case",
    "setup_for",
]
