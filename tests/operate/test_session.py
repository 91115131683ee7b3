"""A stage in operation, in lockstep: the shipped controller, bus, node and plant, and somebody who gives commands."""

import numpy as np
import pytest
from operated_rig import MIDDLE_M, PERIOD_S, OperatedRig, Script, require_smooth, tracked

from hil.operate.commands import Activity, State, Verb
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.monitors import SenseStatus

NAN = np.nan


def test_from_off_to_a_new_target_in_flight_and_back_to_off():
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        first = rig.give(Verb.MOVE, target_m=(4e-6, NAN, NAN))
        yield from rig.wait_s(0.004)
        assert rig.session.state["activity"] == Activity.MOVING
        second = rig.give(Verb.MOVE, target_m=(-3e-6, 2e-6, NAN))
        yield from rig.until_final(second)
        assert rig.state_of(first) is State.ABORTED
        assert rig.words_of(first) == f"MOVE (command {second}) has taken its place"
        assert rig.state_of(second) is State.DONE
        assert rig.session.state["in_position"] == 1
        assert (yield from rig.do(Verb.MOVE, relative=1, target_m=(1e-6, NAN, -1e-6))) is State.DONE
        assert np.allclose(rig.session.stage.setpoints.target_m, [-2e-6, 2e-6, 17e-6], atol=1e-15)
        assert (yield from rig.do(Verb.PARK)) is State.DONE
        assert rig.session.state["activity"] == Activity.OFF

    rows = rig.play(script())
    require_smooth(rows)
    assert not rig.controller.faults
    error = tracked(rows)["position_m"] - tracked(rows)["reference_m"]
    assert 0.5e-9 < np.abs(error).max() < 6e-9
    speed = np.abs(np.diff(tracked(rows)["reference_m"][:, 0])) / PERIOD_S
    turn = np.flatnonzero(np.diff(np.sign(np.diff(tracked(rows)["reference_m"][:, 0]))))
    assert speed.max() > 0.2e-3  # it was at speed ...
    assert len(turn) >= 1  # ... and turned round in flight
    assert (rows["voltage_v"][-1] == 0).all()


def test_a_command_reaches_the_law_in_the_next_tick_and_what_the_law_has_seen_is_kept():
    """Two runs that differ by one command alone: the law looks three rows ahead, the first row behind them is another
    one, and with it the force of the very next tick.
    """

    def recorded(is_moved: bool) -> np.ndarray:
        rig = OperatedRig()

        def script() -> Script:
            yield from rig.switched_on()
            given_at.append(len(rig.rows))
            if is_moved:
                rig.give(Verb.MOVE, target_m=(1e-6, NAN, NAN))
            yield from rig.wait_s(0.01)

        return rig.play(script())

    given_at: list[int] = []
    still, moved = recorded(False), recorded(True)
    assert given_at[0] == given_at[1]
    differs = (still["reference_m"] != moved["reference_m"]).any(axis=1)
    assert np.flatnonzero(differs)[0] == given_at[0] + 4  # n + 1, n + 2, n + 3 the law had seen
    acts = (still["demand_n"] != moved["demand_n"]).any(axis=1)
    assert np.flatnonzero(acts)[0] == given_at[0] + 1


@pytest.mark.parametrize(
    ("verb", "fields", "words"),
    [
        (Verb.MOVE, {"target_m": (20e-6, NAN, NAN)}, "x = 20 um is asked for, limits -13.51 to 13.51 um"),
        (Verb.MOVE, {"target_m": (NAN, NAN, 45e-6)}, "z = 45 um is asked for, limits 0 to 36.99 um"),
        (Verb.MOVE, {"target_m": (np.inf, NAN, NAN)}, "a target has to be finite"),
        (Verb.MOVE, {"target_m": (1e-6, NAN, NAN), "jerk_m_per_s3": -1.0}, "jerk_m_per_s3 is -1"),
        (Verb.MOVE, {"target_m": (5e-6, NAN, NAN), "velocity_m_per_s": 0.1, "acceleration_m_per_s2": 500.0,
                     "jerk_m_per_s3": 1e6}, "on the way, at ("),
        (Verb.HOME, {}, "disable or park first"),
        (Verb.RESUME, {}, "nothing is paused"),
        (Verb.PAUSE, {}, "nothing moves"),
        (Verb.CLEAR, {}, "there is no fault"),
        (Verb.SETTLE, {"window_m": 1.0}, "limits 1e-10 to 1e-05 m"),
        (Verb.JOG, {"target_m": (1.0, 1.0, 0.0)}, "along one axis"),
        (99, {}, "there is no verb 99"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_before_anything_moves(verb, fields, words):
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        begun = len(rig.rows)
        command = rig.give(verb, **fields)
        yield from rig.until_final(command)
        assert rig.state_of(command) is State.REFUSED
        assert words in rig.words_of(command)
        yield from rig.wait_s(0.01)
        assert {tuple(row["reference_m"]) for row in rig.rows[begun:]} == {MIDDLE_M}

    rig.play(script())


def test_before_the_loop_is_closed_moves_are_refused_with_what_to_do():
    rig = OperatedRig()

    def script() -> Script:
        for verb, words in ((Verb.MOVE, "home, then enable"), (Verb.ENABLE, "home first")):
            command = rig.give(verb)
            yield from rig.until_final(command)
            assert rig.state_of(command) is State.REFUSED
            assert words in rig.words_of(command)
        assert (yield from rig.do(Verb.STOP)) is State.DONE

    rows = rig.play(script())
    assert (rows["voltage_v"] == 0).all()


@pytest.mark.parametrize("verb", [Verb.STOP, Verb.ABORT])
def test_a_move_is_stopped_smoothly_and_the_stage_holds(verb):
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        move = rig.give(Verb.MOVE, target_m=(6e-6, 3e-6, NAN))
        yield from rig.wait_s(0.006)
        given = len(rig.rows)
        assert (yield from rig.do(verb)) is State.DONE
        assert rig.state_of(move) is State.ABORTED
        assert (len(rig.rows) - given) * PERIOD_S < 0.03
        assert rig.session.state["activity"] == Activity.HOLDING
        yield from rig.wait_s(0.02)

    rows = rig.play(script())
    require_smooth(rows)
    reference = tracked(rows)["reference_m"]
    assert np.ptp(reference[-90:], axis=0).max() == 0.0
    assert 0.5e-6 < reference[-1, 0] < 5.5e-6
    if verb is Verb.ABORT:  # on the line
        assert np.isclose(reference[-1, 1] / reference[-1, 0], 0.5, rtol=1e-6)


def test_a_jog_goes_on_while_it_is_renewed_and_ends_within_300_ms_of_silence():
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        jog = rig.give(Verb.JOG, target_m=(0.0, 1.0, 0.0), velocity_m_per_s=5e-6)
        for _ in range(8):
            yield from rig.wait_s(0.1)
            rig.give(Verb.JOG, same_id=jog, target_m=(0.0, 1.0, 0.0), velocity_m_per_s=5e-6)
            assert rig.session.state["activity"] == Activity.JOGGING
        silent_at = len(rig.rows)
        yield from rig.until_final(jog)
        assert (len(rig.rows) - silent_at) * PERIOD_S < 0.3
        assert "not renewed" in rig.words_of(jog)
        y = rig.session.stage.setpoints.target_m[1]
        assert 4e-6 < y < 6e-6  # 0.8 s and a lease at 5 um/s
        jog = rig.give(Verb.JOG, target_m=(0.0, -1.0, 0.0), velocity_m_per_s=5e-6)
        yield from rig.wait_s(0.05)
        rig.give(Verb.JOG, target_m=(0.0, 0.0, 0.0))
        assert (yield from rig.until_final(jog)) is State.DONE
        assert "was ended" in rig.words_of(jog)
        yield from rig.wait_s(0.01)

    require_smooth(rig.play(script()))


def test_a_jog_stops_at_the_end_of_what_the_combs_hold():
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        jog = rig.give(Verb.JOG, target_m=(1.0, 0.0, 0.0))
        for _ in range(4):
            yield from rig.wait_s(0.1)
            rig.give(Verb.JOG, same_id=jog, target_m=(1.0, 0.0, 0.0))
        assert rig.state_of(jog) is State.DONE
        assert "at the end of what the combs hold along x" in rig.words_of(jog)
        x = rig.session.stage.setpoints.target_m[0]
        assert np.isclose(x, 0.999 * rig.reach.farthest(np.array(MIDDLE_M), 0, 1.0), rtol=1e-9)

    rig.play(script())
    assert not rig.controller.faults


@pytest.mark.parametrize("verb", [Verb.MOVE, Verb.JOG])
def test_a_loop_that_is_closed_again_holds_rest_wherever_it_was_opened(verb):
    """In the middle of a way: neither where it led nor where it had come to is what the next enable holds."""
    rig = OperatedRig()
    at: list[int] = []

    def script() -> Script:
        yield from rig.switched_on()
        rig.give(verb, target_m=(1.0, 0.0, 0.0) if verb is Verb.JOG else (6e-6, 3e-6, NAN))
        yield from rig.wait_s(0.006)
        assert (yield from rig.do(Verb.DISABLE)) is State.DONE
        at.append(len(rig.rows))
        assert (yield from rig.do(Verb.ENABLE)) is State.DONE
        assert rig.session.state["activity"] == Activity.HOLDING
        assert not rig.session.state["target_m"].any()
        yield from rig.wait_s(0.02)
        at.append(len(rig.rows))
        assert (yield from rig.do(Verb.MOVE, target_m=MIDDLE_M)) is State.DONE

    rows = rig.play(script())
    assert not rig.controller.faults
    assert not tracked(rows[at[0] : at[1]])["reference_m"].any()
    require_smooth(rows[at[0] :])


def test_released_by_hand_is_led_down_in_5_ms_and_latched_until_cleared():
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        move = rig.give(Verb.MOVE, target_m=(3e-6, NAN, NAN))
        yield from rig.wait_s(0.003)
        given = len(rig.rows)
        rig.give(Verb.RELEASE)
        yield from rig.until_final(move)
        assert rig.state_of(move) is State.ABORTED
        assert rig.session.state["activity"] == Activity.FAULT
        voltage = np.array([row["voltage_v"] for row in rig.rows[given : given + 28]])
        assert voltage[0].min() > 100.0
        assert not voltage[27].any()
        assert np.abs(np.diff(voltage, axis=0)).max() < 16.0, "of 20 V that a tick may have"
        assert any(n == 0 and "OPERATOR" in words for n, _, words in rig.answers)
        refused = rig.give(Verb.ENABLE)
        yield from rig.until_final(refused)
        assert rig.state_of(refused) is State.REFUSED
        yield from rig.wait_s(0.05)
        assert rig.rows[-1]["sense_status"] & SenseStatus.MISSING
        assert (yield from rig.do(Verb.CLEAR)) is State.DONE
        assert rig.session.state["missed"] <= rig.controller.missed_ticks < 50  # a released node owes no sample
        assert rig.session.state["homed"] == 0
        yield from rig.switched_on()

    rig.play(script())


def test_what_is_missed_in_a_fault_is_no_missed_tick():
    """At rate a tick without a sense frame waits for it so long that it is late: 1000 a second were told in FAULT."""
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        before = int(rig.session.state["missed"][0])
        rig.give(Verb.RELEASE)
        while rig.session.state["activity"] != Activity.FAULT:
            yield
        for _ in range(10):
            rig.controller.missed_ticks += 7
            yield
        assert (yield from rig.do(Verb.CLEAR)) is State.DONE
        assert rig.session.state["missed"] == before
        rig.controller.missed_ticks += 3
        yield
        assert rig.session.state["missed"] == before + 3

    rig.play(script())


def test_auto_zero_comes_back_to_where_the_stage_held():
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        assert (yield from rig.do(Verb.AUTO_ZERO)) is State.DONE
        assert np.array_equal(rig.session.stage.setpoints.target_m, MIDDLE_M)
        assert rig.session.state["in_position"] == 1

    rows = rig.play(script())
    assert (rows["mode"] == Mode.HOMING).sum() > 400  # twice


def test_in_position_takes_window_and_dwell_as_they_are_set():
    rig = OperatedRig()
    ends: list[int] = []

    def script() -> Script:
        yield from rig.switched_on()
        for window_m, dwell_s in ((20e-9, 2e-3), (1e-9, 0.0), (20e-9, 50e-3)):
            assert (yield from rig.do(Verb.SETTLE, window_m=window_m, dwell_s=dwell_s)) is State.DONE
            begun = len(rig.rows)
            state = yield from rig.do(Verb.MOVE, relative=1, target_m=(0.1e-6, NAN, NAN))
            assert state is State.DONE
            ends.append(len(rig.rows) - begun)
        yield from rig.do(Verb.SETTLE, window_m=0.1e-9, dwell_s=0.1)
        state = yield from rig.do(Verb.MOVE, relative=1, target_m=(0.1e-6, NAN, NAN))
        assert state is State.ABORTED
        assert "has not been within 0.1 nm of it for 100 ms" in rig.answers[-1][2]

    rig.play(script())
    assert ends[2] - ends[0] >= 0.04 / PERIOD_S


def test_random_commands_never_lose_the_stage():
    """Whatever is asked, in whatever order: no voltage beyond its limit, no set-point that jumps, no fault but by
    hand, and afterwards it obeys."""
    rng = np.random.default_rng(12)
    rig = OperatedRig()
    verbs = [v for v in Verb if v < Verb.RELEASE and v is not Verb.PATH]

    def script() -> Script:
        yield from rig.switched_on()
        for _ in range(150):
            verb = verbs[rng.integers(len(verbs))]
            target = rng.uniform(-6e-6, 6e-6, 3) + np.array(MIDDLE_M)
            if verb is Verb.JOG:
                target = np.eye(3)[rng.integers(3)] * rng.choice([-1.0, 1.0])
            fields = {"target_m": target, "relative": 0, "window_m": 20e-9, "dwell_s": 1e-3}
            rig.give(verb, **fields)
            yield from rig.wait_s(float(rng.exponential(0.01)))
        yield from rig.do(Verb.STOP)
        yield from rig.do(Verb.ABORT)
        if not rig.session.stage.is_driven:
            yield from rig.do(Verb.HOME)
            assert (yield from rig.do(Verb.ENABLE)) is State.DONE
        assert (yield from rig.do(Verb.MOVE, target_m=MIDDLE_M)) is State.DONE

    rows = rig.play(script())
    assert not rig.controller.faults
    assert rows["voltage_v"].max() <= 200.0
    finals = {n for n, state, _ in rig.answers if state in (State.DONE, State.REFUSED, State.ABORTED)}
    assert finals >= set(range(1, rig._id + 1)), "every command came to an end"


@pytest.mark.parametrize("verb", [Verb.PARK, Verb.AUTO_ZERO])
def test_a_stage_that_cannot_be_in_position_can_be_parked(verb):
    """Under voltage it would stay only because something disturbs it, or the window is too small for its noise."""
    rig = OperatedRig()

    def script() -> Script:
        yield from rig.switched_on()
        assert (yield from rig.do(Verb.SETTLE, window_m=0.1e-9, dwell_s=0.1)) is State.DONE
        command = rig.give(verb)
        state = yield from rig.until_final(command)
        if verb is Verb.PARK:
            assert state is State.DONE, rig.words_of(command)
            yield from rig.wait_s(0.002)
            assert rig.session.state["activity"] == Activity.OFF
            assert not rig.rows[-1]["voltage_v"].any()
        else:
            assert state is State.ABORTED
            assert "the set-point is at (0, 0, 18) um, but the stage has not been within 0.1 nm" in rig.words_of(
                command
            )
            assert rig.session.state["activity"] == Activity.HOLDING

    rows = rig.play(script())
    assert (rows["mode"] == Mode.HOMING).sum() > (400 if verb is Verb.AUTO_ZERO else 200)
    down = np.flatnonzero(rows["mode"] == Mode.LANDING)[0]
    assert not rows["reference_m"][down - 1].any(), "led to rest, and not dropped"


def test_a_stage_that_has_just_closed_its_loop_can_be_parked():
    rig = OperatedRig()

    def script() -> Script:
        assert (yield from rig.do(Verb.HOME)) is State.DONE
        enable = rig.give(Verb.ENABLE)
        while rig.session.stage.mode != Mode.ENABLED:
            yield
        assert (yield from rig.do(Verb.PARK)) is State.DONE, rig.answers
        assert rig.state_of(enable) is State.ABORTED
        assert rig.session.stage.mode == Mode.IDLE

    rig.play(script())
