"""The verdicts of the matrix are the limits themselves: what is a little beyond one of them is told."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from defective.kernels import planted, says_nothing

from hil.faults.injection import Injection
from hil.lanes.lockstep import LockstepRig
from hil.node.amplifier import AmplifierNode
from hil.studies.faults.matrix import CASES
from hil.studies.faults.outcome import RISE_V, Outcome, _problems, largest_rise_v, largest_step_v, run_case, setup_for
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.loop import exchange
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip


@cache
def scan():
    return setup_for("lqg")


def case(text):
    return next(c for c in CASES if c.text == text)


def applied_as_shipped(self, counts, t_us):
    self._drive.pending, self._silent_syncs, self.outputs = None, 0, counts
    return counts


def steps(self, counts, t_us):
    """25 V too much at comb 1, once."""
    self.applied = getattr(self, "applied", 0) + 1
    a, b, c = counts
    return applied_as_shipped(self, (a + 4096, b, c) if self.applied == 1050 else counts, t_us)


def steps_after_the_clear(self, counts, t_us):
    """25 V too much at comb 1, once, on the way up that follows the fault; a release is at once and passes nothing."""
    a, b, c = counts
    self.highest = max(getattr(self, "highest", 0), a)
    if self.highest > 20_000 and 8_000 < a < 12_000:
        a, self.highest = a + 4096, 0
    return applied_as_shipped(self, (a, b, c), t_us)


def exceeds(self, counts, t_us):
    a, b, c = counts
    return applied_as_shipped(self, (36_000, b, c) if a > 20_000 else counts, t_us)


def lifting(by_v):
    """An amplifier whose channel 1 gains an offset 30 ms after the fault, while no voltage is allowed."""
    arm = Injection.arm

    def armed(self):
        clock, params = arm(self), self._plant.plant.params
        self._clock.call_at(self.origin_us + 250_000, lambda: params["amplifier_offset_v"].__setitem__((0, 0), by_v))
        return clock

    return armed


@pytest.mark.parametrize(
    ("owner", "part", "defect", "fault", "words"),
    [
        (AmplifierNode, "_apply", steps, "sense.1:off", "a step of 25"),
        (AmplifierNode, "_apply", steps_after_the_clear, "sense.1:off", "a step of 25"),
        (AmplifierNode, "_apply", exceeds, "sense.1:off", "beyond 200 V"),
        (Injection, "arm", lifting(0.3), "sense.1:off", "a comb rose by 0.3 V after the decision"),
        (Injection, "arm", lifting(1.2), "sense.1:off", "after the release at"),
        (exchange, "begin", planted(exchange.begin, release=says_nothing), "bus.sync:drop", "not within 0.4 ms"),
        (Controller, "__init__", None, "bus.sense:drop", "instead of 5"),
        (Controller, "_enter", None, "bus.sync:drop", "a voltage was commanded in a mode that allows none"),
    ],
)
def test_what_is_a_little_beyond_a_bound_is_told(monkeypatch, owner, part, defect, fault, words):
    if part == "__init__":
        defect = forgiving(Controller.__init__)
    if part == "_enter":
        defect = commanding(Controller._enter)
    monkeypatch.setattr(owner, part, defect)
    if owner is AmplifierNode:  # whole ticks are played by kernels, which have no such defect
        monkeypatch.setattr(LockstepRig, "_stretches_of", lambda rig: None)
    problems = run_case("lqg", scan(), case(fault)).problems
    assert any(words in problem for problem in problems), problems


def forgiving(made):
    """Three more ticks without a frame are forgiven: the decision comes as much later."""

    def forgiving_made(self, *arguments, **named):
        made(self, *arguments, **named)
        self.law["limits"]["stale_count"] += 3

    return forgiving_made


def commanding(enter):
    def entered(self):
        enter(self)
        self.memory["row"]["drive_count"][0, 1] = 7

    return entered


ONSET = 1100
SAVED = Outcome("lqg", "sense.1:off", ("SENSE_RANGE_1",), 5, 200.0, 20.0, 0.1, 0.4, 0.0, ("stop",), True, ())
"""At its bounds in everything that is bounded."""


def told(outcome, ticks=5, trips=Trip.SENSE_RANGE_1):
    """What the verdict says of an outcome whose fault was decided so many ticks after its beginning, and cleared."""
    rows = np.zeros(2000, ROW)
    rows["mode"] = Mode.TRACKING
    rows["mode"][ONSET + ticks : ONSET + 255], rows["mode"][ONSET + 255 : 1600] = Mode.FAULT, Mode.BOOT
    rows["trips"][ONSET + ticks] = trips
    return _problems(case("sense.1:off"), scan(), rows, outcome, ONSET, ONSET + ticks, True)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"voltage_max_v": 200.1}, "200.1 V at a comb, beyond 200 V"),
        ({"slew_max_v": 20.1}, "a step of 20.1 V in a tick, beyond 20 V"),
        ({"rise_max_v": 0.11}, "a comb rose by 0.1 V after the decision"),
        ({"zero_ms": 0.6}, "0 V after 0.6 ms, not within 0.4 ms"),
        ({"zero_ms": None}, "0 V after never, not within 0.4 ms"),
        ({"events": ("broken", "stop")}, "the stage is damaged: broken, stop"),
        ({"events": ("pulled_in",)}, "the stage is damaged: pulled_in"),
        ({"recovered": False}, "did not track again after the clear"),
    ],
)
def test_at_a_bound_all_is_well_and_beyond_it_that_is_told(changes, words):
    assert told(SAVED) == []
    assert told(dataclasses.replace(SAVED, **changes)) == [words]


def test_a_decision_too_late_too_early_or_for_another_cause_is_told():
    assert told(SAVED, ticks=6) == ["noticed after 6 ticks instead of 5"]
    assert told(SAVED, ticks=-1) == ["a fault 1 ticks before anything was wrong"]
    assert told(SAVED, trips=Trip.OVERRUN) == ["latched SENSE_RANGE_1, which is not the cause"]


def test_steps_and_rises_are_those_of_the_whole_run():
    step, low = 20.0, 0.0
    volts = np.array([0.0, 10.0, 30.0, 50.0, 49.0, 0.0, 0.0, 0.0])[:, np.newaxis]
    assert largest_step_v(volts) == step
    assert largest_step_v(volts[:4], volts[4]) == step
    fall = np.array([100.0, 100.0, 40.0, 0.0, 0.0])[:, np.newaxis]  # looked at in the middle of a release
    assert largest_step_v(fall) == low
    assert largest_step_v(np.array([100.0, 100.0, 40.0, 40.0])[:, np.newaxis]) == 60.0
    assert largest_step_v(np.array([100.0, np.nan, 40.0, 41.0])[:, np.newaxis]) == 1.0
    late = np.array([50.0, 50.0, 0.0, 0.0, 0.0, 0.3])[:, np.newaxis]
    assert largest_rise_v(late, np.array([False, True, True, True, True, True])) == 0.3
    assert largest_rise_v(late, np.array([False, True, True, True, True, False])) == low


def test_every_bound_of_the_matrix_follows_from_a_limit():
    limits = scan().controller.limits
    assert isinstance(scan().controller, ControllerConfig)
    assert RISE_V == 0.1  # 16 counts
    assert (limits.voltage_max_v, limits.slew_max_v_per_s * scan().bus.period_s) == (200.0, pytest.approx(20.0))
    for each in CASES:
        assert each.discharged_within_ms in (None, 21.0)  # two ticks, or the node's own 20 ms and the look after them
        assert dataclasses.replace(scan(), faults=(each.fault,)).faults[0].at_s == 0.22
