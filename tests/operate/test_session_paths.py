"""Paths of a stage in operation: streamed, paused, gone on with, and stopped where rows or the server stay away."""

import numpy as np
import pytest
from operated_rig import MIDDLE_M, PERIOD_S, Feeder, OperatedRig, Script, raster_rows, tracked

from hil.operate.commands import Activity, State, Verb
from hil.operate.settings import Settings
from pkxyz_ctrl.trajectory import Move, Trajectory

NAN = float("nan")


def rows_away() -> tuple[np.ndarray, np.ndarray]:
    """A path that ends where it did not begin, as rows, and its end."""
    way = Move(
        kind="move", to_m=(2e-6, -1e-6, 0.5e-6), velocity_max_m_per_s=20e-6, acceleration_max_m_per_s2=0.5,
        jerk_max_m_per_s3=300.0,
    )  # fmt: skip
    trajectory = Trajectory([way])
    rows = trajectory.sample(0, trajectory.duration_us // 200 + 2, 200)
    rows[:, 0:3] += MIDDLE_M
    return rows, rows[-1, 0:3].copy()


def test_a_path_is_followed_paused_resumed_and_not_left():
    rows, start = raster_rows()
    rig = OperatedRig()
    feeder = Feeder(rig, 7, rows)
    after_pause: list[int] = []

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=7, rows=len(rows), start_m=start, target_m=rows[-1, 0:3])
        while rig.session.state["progress"][0] < 0.4:
            yield
        assert rig.session.state["activity"] == Activity.SCANNING
        refused = rig.give(Verb.MOVE, target_m=(0, 0, 18e-6))
        yield
        yield
        assert rig.state_of(refused) is State.REFUSED
        assert f"PATH (command {path}) is running" in rig.words_of(refused)
        assert (yield from rig.do(Verb.PAUSE)) is State.DONE
        assert rig.session.state["activity"] == Activity.PAUSED
        yield from rig.wait_s(0.05)
        after_pause.append(len(rig.rows))
        assert (yield from rig.do(Verb.RESUME)) is State.DONE
        assert (yield from rig.until_final(path)) is State.DONE
        assert not feeder.stopped

    recorded = tracked(rig.play(script()))
    reference = recorded["reference_m"]
    still = np.flatnonzero((np.diff(reference, axis=0) == 0).all(axis=1))
    assert len(still) > 200  # the pause
    dense, _ = raster_rows(period_us=4)
    turned = np.flatnonzero(np.diff(still) > 1)  # about the pause, where rows are not those of the path
    for point in reference[still[turned[-1] + 1] - 60 : still[-1] + 60]:
        assert np.abs(dense[:, 0:3] - point).max(axis=1).min() < 1.1e-9
    assert np.allclose(reference[-1], rows[-1, 0:3], atol=1e-15)
    error = recorded["position_m"] - reference
    assert np.abs(error).max() < 12e-9


def test_a_path_whose_rows_stop_coming_is_paused_in_time_and_goes_on_when_they_come():
    """A feeder that was killed: the path stops on itself, with rows to spare, and nothing faults."""
    rows, start = raster_rows()
    rig = OperatedRig()
    feeder = Feeder(rig, 1, rows)

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start, target_m=rows[-1, 0:3])
        rig.session.stage.path = None
        while rig.session.stage.path is None or rig.session.stage.path.wants < 1000:
            yield
        feeder.stopped = True
        while rig.session.state["activity"] != Activity.PAUSED:
            yield
        assert any("have not come in time" in words for n, _, words in rig.answers if n == path)
        refused = rig.give(Verb.RESUME)
        yield from rig.until_final(refused)
        assert "have not come yet" in rig.words_of(refused)
        feeder.stopped = False
        yield from rig.wait_s(0.05)
        assert (yield from rig.do(Verb.RESUME)) is State.DONE
        assert (yield from rig.until_final(path)) is State.DONE

    recorded = rig.play(script())
    assert not rig.controller.faults
    assert np.abs(np.diff(tracked(recorded)["reference_m"], 2, axis=0)).max() / PERIOD_S**2 < 0.8


def test_rows_that_cannot_be_followed_are_not():
    """A server that sends what it never checked: the path stops before it."""
    rows, start = raster_rows()
    rows[900:, 0] += 3e-6
    rig = OperatedRig()
    Feeder(rig, 1, rows)

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start, target_m=rows[-1, 0:3])
        assert (yield from rig.until_final(path)) is State.ABORTED
        assert "jumps" in rig.words_of(path)
        yield from rig.wait_s(0.02)
        assert rig.session.state["activity"] == Activity.HOLDING

    recorded = rig.play(script())
    assert np.abs(np.diff(tracked(recorded)["reference_m"], axis=0)).max() < 0.2e-6


@pytest.mark.parametrize("on_silence", ["hold", "park"])
def test_a_server_that_falls_silent_stops_the_path_within_100_ms(on_silence):
    rows, start = raster_rows()
    rig = OperatedRig(settings=Settings(on_silence=on_silence))
    Feeder(rig, 1, rows)
    alive = [True]
    count = [0]

    def sign_of_life() -> None:
        count[0] += alive[0]
        rig.session.server_says(count[0])

    rig.every_tick.append(sign_of_life)

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start, target_m=rows[-1, 0:3])
        while rig.session.state["progress"][0] < 0.3:
            yield
        alive[0] = False
        silent_at = len(rig.rows)
        assert (yield from rig.until_final(path)) is State.ABORTED
        while rig.session.state["activity"] in (Activity.SCANNING, Activity.STOPPING):
            yield
        assert (len(rig.rows) - silent_at) * PERIOD_S < 0.1
        yield from rig.wait_s(0.2)
        assert rig.session.state["activity"] == (Activity.HOLDING if on_silence == "hold" else Activity.OFF)
        alive[0] = True
        yield from rig.wait_s(0.01)
        if on_silence == "hold":
            assert (yield from rig.do(Verb.MOVE, target_m=MIDDLE_M)) is State.DONE

    recorded = rig.play(script())
    assert not rig.controller.faults
    assert np.abs(np.diff(tracked(recorded)["reference_m"], 2, axis=0)).max() / PERIOD_S**2 < 0.8


@pytest.mark.parametrize("after", [Verb.RESUME, Verb.PAUSE, Verb.STOP, Verb.ABORT])
def test_a_pause_that_something_else_takes_the_place_of_comes_to_an_end(after):
    rows, start = raster_rows()
    rig = OperatedRig()
    Feeder(rig, 1, rows)

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start, target_m=rows[-1, 0:3])
        while rig.session.state["progress"][0] < 0.3:
            yield
        pause = rig.give(Verb.PAUSE)
        yield from rig.wait_s(0.001)
        assert rig.state_of(pause) is State.RUNNING  # it takes some 20 ms to stand
        other = rig.give(after)
        yield from rig.until_final(other)
        assert rig.state_of(pause) is State.ABORTED
        assert rig.words_of(pause) == f"{after.name} (command {other}) has taken its place"
        if after is Verb.RESUME:
            assert (yield from rig.until_final(path)) is State.DONE

    rig.play(script())


def test_a_pause_comes_to_an_end_when_the_server_falls_silent():
    rows, start = raster_rows()
    rig = OperatedRig()
    Feeder(rig, 1, rows)

    def script() -> Script:
        yield from rig.switched_on()
        rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start, target_m=rows[-1, 0:3])
        while rig.session.state["progress"][0] < 0.3:
            yield
        rig.session.server_says(1)  # for the last time
        yield from rig.wait_s(rig.session.settings.silence_s - 0.002)
        pause = rig.give(Verb.PAUSE)
        yield from rig.wait_s(0.1)
        assert rig.state_of(pause) is State.ABORTED
        assert rig.words_of(pause) == "the server has fallen silent"

    rig.play(script())


def test_axes_that_a_move_leaves_out_stay_where_the_path_ended():
    rows, end = rows_away()
    rig = OperatedRig()
    Feeder(rig, 1, rows)

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=rows[0, 0:3], target_m=end)
        while rig.session.state["progress"][0] < 0.3:
            yield
        assert np.array_equal(rig.session.state["target_m"][0], end)
        assert (yield from rig.do(Verb.PAUSE)) is State.DONE
        assert np.array_equal(rig.session.state["target_m"][0], end)
        yield from rig.do(Verb.RESUME)
        assert (yield from rig.until_final(path)) is State.DONE
        assert np.array_equal(rig.session.state["target_m"][0], end)
        assert (yield from rig.do(Verb.MOVE, target_m=(1e-6, NAN, NAN))) is State.DONE
        assert np.array_equal(rig.session.state["target_m"][0], [1e-6, end[1], end[2]])
        assert (yield from rig.do(Verb.MOVE, relative=1, target_m=(NAN, 1e-6, NAN))) is State.DONE

    reference = tracked(rig.play(script()))["reference_m"]
    assert np.allclose(reference[-1], [1e-6, end[1] + 1e-6, end[2]], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("by", [Verb.ABORT, Verb.STOP])
def test_axes_that_a_move_leaves_out_stay_where_a_path_was_broken_off(by):
    rows, end = rows_away()
    rig = OperatedRig()
    Feeder(rig, 1, rows)
    stands: list[np.ndarray] = []

    def script() -> Script:
        yield from rig.switched_on()
        rig.give(Verb.PATH, path=1, rows=len(rows), start_m=rows[0, 0:3], target_m=end)
        while rig.session.state["progress"][0] < 0.3:
            yield
        assert (yield from rig.do(by)) is State.DONE
        yield from rig.wait_s(0.002)
        stands.append(rig.session.state["target_m"][0].copy())
        assert np.allclose(rig.rows[-1]["reference_m"], stands[0], rtol=0.0, atol=1e-15)
        assert (yield from rig.do(Verb.MOVE, target_m=(1e-6, NAN, NAN))) is State.DONE

    reference = tracked(rig.play(script()))["reference_m"]
    assert rows[0, 0] < stands[0][0] < end[0]
    assert np.allclose(reference[-1], [1e-6, *stands[0][1:]], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("said", "state", "words"),
    [
        ((NAN, NAN, NAN), State.REFUSED, "the path's end: a target has to be finite"),
        ((0.0, 0.0, 60e-6), State.REFUSED, "the path's end: (0, 0, 60) um can't be held"),
        (MIDDLE_M, State.ABORTED, "the path does not end where it was said to"),
    ],
)
def test_a_path_has_to_end_where_it_was_said_to(said, state, words):
    rows, _ = rows_away()
    rig = OperatedRig()
    Feeder(rig, 1, rows)

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=rows[0, 0:3], target_m=said)
        assert (yield from rig.until_final(path)) is state
        assert words in rig.words_of(path)
        yield from rig.wait_s(0.002)
        assert rig.session.state["activity"] == Activity.HOLDING

    rig.play(script())
