"""What the measurements stand on: a stretch of a run that is played again, a stopwatch, a figure with its verdict.

No time is judged here: that would be a test of the machine.
"""

import gc
import itertools

import numpy as np
import pytest
from sim_rig import config, counts, plant

from hil.bench.rigs import figure
from hil.bench.rigs.closed_loop import scan
from hil.bench.rigs.figure import Figure
from hil.bench.rigs.played import Played, PlayedPort, drive_counts, recorded_frames
from hil.bench.rigs.reference_motion import reference_motion
from hil.runs.scenario import load_scenario


def test_a_controller_alone_with_the_frames_of_a_run_sends_what_it_sent_in_the_run() -> None:
    setup = load_scenario("raster").setup()
    came, went = recorded_frames(setup)
    played = Played(setup, PlayedPort(came))
    played.run()
    assert played.controller.faults == []
    node = setup.gate.node_id
    ours, theirs = (drive_counts(frames, node) for frames in (played.port.sent, went))
    assert np.array_equal(ours[: len(theirs)], theirs)


def test_verdicts_state_by_state() -> None:
    for value, direction in itertools.product((2.9, 3.0, 3.1), ("at most", "at least")):
        expected = value <= 3.0 if direction == "at most" else value >= 3.0
        assert Figure("a.b", value, "us", 3.0, direction).met is expected
    assert Figure("a.b", 1.0, "us").met is None


def test_best_and_median() -> None:
    times = figure.times_of([3e-6, 1e-6, 2e-6, 8e-6])
    assert times == pytest.approx((1e-6, 2.5e-6))
    assert times.per(2) == pytest.approx((0.5, 1.25))


def test_the_stopwatch_leaves_the_garbage_collector_as_it_was() -> None:
    during = []

    def fail() -> None:
        during.append(gc.isenabled())
        raise ZeroDivisionError

    for enabled in (True, False):
        (gc.enable if enabled else gc.disable)()
        try:
            with pytest.raises(ZeroDivisionError):
                figure.once(fail)
            assert gc.isenabled() is enabled
        finally:
            gc.enable()
    assert during == [False, False]


def test_the_recorded_stretch_is_the_scan_in_closed_loop() -> None:
    loop = scan()
    rows = loop.rows
    np.testing.assert_array_equal(np.diff(rows["tick"]), 1)
    np.testing.assert_array_equal(np.diff(rows["reference_tick"]), 1)
    assert rows["tick"][0] == loop.memory["tick_index"][0]
    assert len(rows) * loop.setup.bus.period_us == 100_000
    error_nm = np.sqrt(((rows["position_m"] - rows["reference_m"]) ** 2).mean(axis=0)) * 1e9
    assert np.all(error_nm > 0.2)
    assert np.all(error_nm < 5.0)
    assert np.ptp(rows["reference_m"][:, 0]) == pytest.approx(4.0e-6, rel=0.3)


def test_reference_motion_stays_where_nothing_pulls() -> None:
    p = plant(config(amplifier_bandwidth={"corner_hz": 30e3}))
    before = p.state.tobytes()
    np.testing.assert_allclose(reference_motion(p.params, p.state, np.zeros((3, 3), np.int32), 200), 0.0, atol=1e-15)
    assert p.state.tobytes() == before


def test_reference_motion_refuses_what_slews() -> None:
    p = plant(
        config(amplifier_bandwidth={"corner_hz": 30e3}, slew={"limit_v_per_s": 1e6})
    )  # 5.3 V for 1 / (2 pi 30 kHz)
    reference_motion(p.params, p.state, np.array([counts(5, 5, 5)]), 200)
    with pytest.raises(ValueError, match="slews"):
        reference_motion(p.params, p.state, np.array([counts(5, 5.6, 5)]), 200)
