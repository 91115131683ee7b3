"""Paths of a stage in operation: streamed, paused, gone on with, and stopped where rows or the server stay away."""

import numpy as np
import pytest
from operated_rig import MIDDLE_M, PERIOD_S, Feeder, OperatedRig, Script, raster_rows, tracked

from hil.operate.commands import Activity, State, Verb
from hil.operate.settings import Settings


def test_a_path_is_followed_paused_resumed_and_not_left():
    rows, start = raster_rows()
    rig = OperatedRig()
    feeder = Feeder(rig, 7, rows)
    after_pause: list[int] = []

    def script() -> Script:
        yield from rig.switched_on()
        path = rig.give(Verb.PATH, path=7, rows=len(rows), start_m=start)
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
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start)
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
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start)
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
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start)
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
        path = rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start)
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
        rig.give(Verb.PATH, path=1, rows=len(rows), start_m=start)
        while rig.session.state["progress"][0] < 0.3:
            yield
        rig.session.server_says(1)  # for the last time
        yield from rig.wait_s(rig.session.settings.silence_s - 0.002)
        pause = rig.give(Verb.PAUSE)
        yield from rig.wait_s(0.1)
        assert rig.state_of(pause) is State.ABORTED
        assert rig.words_of(pause) == "the server has fallen silent"

    rig.play(script())
