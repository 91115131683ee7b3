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
from hil.studies.faults.matrix import CLEAR_S, Case
from pkxyz_ctrl.loop.controller import StartUpError
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, Mode
from pkxyz_ctrl.safety.trips import Trip

SCENARIO = "faults"
DISCHARGED_V = 1.0
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
    """most that the voltage of a comb that obeys changed in a tick, releases to 0 V excepted"""
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


def setup_for(law: str, seed: int | None = None) -> Setup:
    """The scan that is broken, under a law of ``configs/controllers`` or of a file. Raises ``ConfigError``."""
    return load_scenario(SCENARIO, controller=law, seed=seed).setup()


def run_case(law: str, setup: Setup, case: Case) -> Outcome:
    """Run one case in the lockstep lane and judge it."""
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
        return Outcome(law, case.text, (), None, 0.0, 0.0, 0.0, 0.0, (), None, (f"did not start: {error}",))
    return _judge(law, case, run_setup, rig, np.concatenate(blocks))


def _judge(law: str, case: Case, setup: Setup, rig: LockstepRig, rows: NDArray[np.void]) -> Outcome:
    period_us = setup.bus.period_us
    onset = case.fault.at_us // period_us
    decided = np.flatnonzero(rows["mode"] == Mode.FAULT)
    decision = int(decided[0]) if len(decided) else None
    trips = Trip(int(rows["trips"][decision])) if decision is not None else Trip(0)
    assert rig.injection is not None
    voltage = np.array(rig.injection.watched)  # at the end of each tick
    held = voltage[: len(rows) if decision is None else decision + 1]
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
        slew_max_v=_slew_v(held[:, list(case.obeys)]),
        zero_ms=zero_ms,
        excursion_um=float(np.abs(strokes).max()) * 1e6 if len(closed) else 0.0,
        events=tuple(sorted({e.kind for e in rig.plant.plant.events})),
        recovered=recovered,
        problems=(),
    )
    return dataclasses.replace(
        outcome, problems=tuple(_problems(case, setup, rows, outcome, onset, decision, released))
    )


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
        ends = round(case.lasts_s * 1e6) // setup.bus.period_us
        if decision - onset > case.within_ticks and not (case.may_go_on and decision - onset >= ends):
            problems.append(f"noticed after {decision - onset} ticks instead of {case.within_ticks}")
        problems += _problems_after(rows, decision)
        if not outcome.recovered:
            problems.append("did not track again after the clear")
    if outcome.voltage_max_v > limits.voltage_max_v * (1 + 1e-9):
        problems.append(f"{outcome.voltage_max_v:.1f} V at a comb, beyond {limits.voltage_max_v:g} V")
    step_v = limits.slew_max_v_per_s * setup.bus.period_s
    if outcome.slew_max_v > step_v * (1 + 1e-3):
        problems.append(f"a step of {outcome.slew_max_v:.1f} V in a tick, beyond {step_v:g} V")
    allowed_ms = case.discharged_within_ms or _ZERO_TICKS * setup.bus.period_us * 1e-3
    if released and (outcome.zero_ms is None or outcome.zero_ms > allowed_ms + 1e-9):
        after = "never" if outcome.zero_ms is None else f"{outcome.zero_ms:g} ms"
        problems.append(f"0 V after {after}, not within {allowed_ms:g} ms")
    if {"pulled_in", "broken"} & set(outcome.events):
        problems.append(f"the stage is damaged: {', '.join(outcome.events)}")
    return problems


def _problems_after(rows: NDArray[np.void], decision: int) -> list[str]:
    """Whether it stayed latched, at 0 V commanded, until the clear."""
    cleared = np.flatnonzero(rows["mode"][decision:] != Mode.FAULT)
    until = decision + (int(cleared[0]) if len(cleared) else len(rows) - decision)
    problems = []
    if rows["drive_count"][decision:until].any():
        problems.append("a voltage was commanded after the decision")
    if len(cleared) and rows["mode"][until] != Mode.BOOT:
        problems.append(f"left FAULT for {Mode(int(rows['mode'][until])).name} without a clear")
    return problems


def _slew_v(voltage: NDArray[np.float64]) -> float:
    """Most that a voltage changed in a tick. A release to 0 V does not count: it may come at once, from anywhere."""
    steps = np.abs(np.diff(voltage, axis=0))
    return float(steps[voltage[1:] > DISCHARGED_V].max(initial=0.0))


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


__all__ = ["DISCHARGED_V", "Outcome", "as_json", "run_case", "setup_for"]
