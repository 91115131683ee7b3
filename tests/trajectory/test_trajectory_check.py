"""The check before a run: forces by hand, every limit at its edge; a refusal names segment, place, limit and key."""

import re
from typing import get_args

import numpy as np
import pytest

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import names
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import AnySegment, Circle, Hold, Move, Sine, Steps, Table, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import KEYS, DriveLimits, check_against
from pkxyz_ctrl.trajectory.comb_forces import comb_forces

STAGE = Stage.load("reconstructed")
MIDDLE = Move(
    kind="move", to_m=(0.0, 0.0, 19.2495e-6), velocity_max_m_per_s=0.5e-3, acceleration_max_m_per_s2=0.05,
    jerk_max_m_per_s3=10.0,
)  # fmt: skip


def drive(slew_max_v_per_s=100e3, voltage_max_v=200.0, period_us=200):
    return DriveLimits(voltage_max_v, slew_max_v_per_s, period_us)


def voltages(trajectory, step_us):
    rows = trajectory.sample(0, trajectory.duration_us // step_us + 1, step_us)
    return np.sqrt(np.maximum(comb_forces(STAGE, rows), 0.0) / STAGE.force_gain_n_per_v2)


def test_comb_forces_are_holding_forces_at_rest_and_carry_inertia_and_damping():
    rows = np.zeros((3, 9))
    rows[:, 2] = 19.2495e-6
    rows[1, 6], rows[2, 3] = 2.0, 1e-3
    still, pushed, moving = comb_forces(STAGE, rows)
    assert still == pytest.approx(STAGE.holding_forces(rows[0, :3]), rel=1e-12)
    transposed = STAGE.jacobian(rows[0, :3]).T
    assert transposed @ (pushed - still) == pytest.approx([4.833e-6 * 2.0, 0.0, 0.0], abs=1e-18)
    # m omega / Q of the published 630.92 Hz and Q = 20
    damping = 4.833e-6 * 2 * np.pi * 630.92 / 20
    assert transposed @ (moving - still) == pytest.approx([damping * 1e-3, 0.0, 0.0], rel=1e-3, abs=1e-12)


@pytest.mark.parametrize("period_us", [50, 200, 250, 500])
def test_the_slew_limit_holds_from_any_instant_to_a_period_later(period_us):
    trajectory = Trajectory([MIDDLE, Circle(kind="circle", radius_m=4e-6, frequency_hz=100.0, turns=3.0)])
    voltage = voltages(trajectory, 10)
    lag = period_us // 10
    fastest = np.abs(voltage[lag:] - voltage[:-lag]).max() / (period_us * 1e-6)
    check_against(STAGE, trajectory, drive(fastest * 1.001, period_us=period_us))
    with pytest.raises(TrajectoryError, match=r"comb \d would have to change .* V within a period of") as refused:
        check_against(STAGE, trajectory, drive(fastest * 0.99, period_us=period_us))
    change = np.abs(voltage[lag:] - voltage[:-lag])
    worst = np.unravel_index(np.argmax(change), change.shape)
    words = str(refused.value)
    assert words.startswith("reference.1 (circle at (0, 0, 19.25) um): on its way, at (")
    assert words.endswith("; change radius_m or frequency_hz")
    named_v = float(words.split("would have to change by ")[1].split(" V")[0])
    assert named_v == pytest.approx(change[worst], rel=2e-3), "to the distance of samples"


def test_the_controllers_voltage_limit_counts_and_so_does_inertia():
    slow, fast = (
        Trajectory([MIDDLE, Sine(kind="sine", axis="z", amplitude_m=0.2e-6, frequency_hz=f, cycles=20.0)])
        for f in (50.0, 1500.0)
    )
    highest = [voltages(t, 5).max() for t in (slow, fast)]
    assert highest[1] > highest[0] + 1.0
    for trajectory, most in zip((slow, fast), highest, strict=True):
        check_against(STAGE, trajectory, drive(1e9, most + 0.05))
        with pytest.raises(TrajectoryError, match=rf"beyond the limit of {most - 0.05:g} V"):
            check_against(STAGE, trajectory, drive(1e9, most - 0.05))
    check_against(STAGE, fast)


def test_announced_jumps_are_left_out_of_the_slew_limit_but_not_of_the_others():
    def jumping(by_um, dwell_s=0.01):
        steps = Steps(kind="steps", by_m=(by_um * 1e-6, 0.0, 0.0), count=2, dwell_s=dwell_s)
        return Trajectory([MIDDLE, steps, Hold(kind="hold", duration_s=0.01)])

    check_against(STAGE, jumping(5.0), drive())
    check_against(STAGE, jumping(5.0, 0.0001), drive())
    with pytest.raises(TrajectoryError, match=r"reference\.1 \(steps at .*stroke \d would be .*; change by_m or count"):
        check_against(STAGE, jumping(20.0), drive())


@pytest.mark.parametrize("name", names("scenarios"))
def test_every_shipped_scenario_loads_and_its_reference_can_be_followed(name):
    scenario = load_scenario(name)
    assert scenario.config.name == name
    end_s = scenario.trajectory.duration_us * 1e-6
    assert end_s + scenario.controller.homing_s + 0.05 < scenario.config.duration_s < end_s + 0.3


def move(to_m, velocity=0.5e-3, acceleration=0.05, jerk=10.0):
    return Move(
        kind="move", to_m=to_m, velocity_max_m_per_s=velocity, acceleration_max_m_per_s2=acceleration,
        jerk_max_m_per_s3=jerk,
    )  # fmt: skip


def refused(*segments):
    with pytest.raises(TrajectoryError) as caught:
        check_against(STAGE, Trajectory(segments), drive())
    return str(caught.value)


@pytest.mark.parametrize(
    ("target_um", "why"),
    [
        ((0.0, 0.0, 49.0), r"stroke \d would be 3\d\.\d* um, outside 0 to 25 um"),
        ((0.0, 0.0, -1.0), r"stroke \d would be -0\.\d* um, outside 0 to 25 um"),
        ((17.0, 0.0, 19.0), r"stroke 2 would be -2\.319 um, outside 0 to 25 um"),
        ((0.0, 0.0, 900.0), "reach"),
    ],
)
def test_a_target_that_cannot_be_held_is_named_with_what_it_would_take_there(target_um, why):
    """The worst value is the target's, not that of the instant at which the limit is passed."""
    words = refused(move(tuple(v * 1e-6 for v in target_um)))
    where = f"({', '.join(f'{v:g}' for v in target_um)}) um"
    assert words.startswith(f"reference.0 (move from (0, 0, 0) um to {where}): at its target {where} ")
    assert re.search(why, words)
    assert words.endswith("; change to_m")


def test_a_move_that_is_too_fast_between_two_good_ends_names_its_limits():
    words = refused(MIDDLE, Hold(kind="hold", duration_s=0.01), move((0.0, 0.0, 1e-6), 0.2, 400.0, 1e7))
    assert words.startswith("reference.2 (move from (0, 0, 19.25) um to (0, 0, 1) um): on its way, at (0, 0, ")
    assert words.endswith("; change velocity_max_m_per_s, acceleration_max_m_per_s2 or jerk_max_m_per_s3")


def test_what_is_too_fast_to_be_pulled_names_the_force():
    words = refused(
        move((0.0, 0.0, 1e-6)), Sine(kind="sine", axis="z", amplitude_m=0.4e-6, frequency_hz=1500.0, cycles=9)
    )
    assert re.match(
        r"reference\.1 \(sine at \(0, 0, 1\) um\): on its way, at \(0, 0, [\d.]+\) um, comb \d would have", words
    )
    assert re.search(r"to push with [\d.]+ uN, and combs only pull; change amplitude_m or frequency_hz$", words)


def test_a_table_is_named_by_its_file(tmp_path):
    file = tmp_path / "mine.csv"
    file.write_text("t_ms, z_um\n0, 0\n50, 10\n100, 30\n150, 48\n200, 20\n", encoding="utf-8")
    fast = {"velocity_max_m_per_s": 1.0, "acceleration_max_m_per_s2": 1e3, "jerk_max_m_per_s3": 1e6}
    words = refused(Table(kind="csv", file=str(file), **fast))
    assert words.startswith(f"reference.0 (csv {file} from (0, 0, 0) um to (0, 0, 20) um): on its way, at (0, 0, ")
    assert re.search(r"stroke \d would be 3\d\.\d* um, outside 0 to 25 um; change the file$", words)


def test_every_kind_of_segment_has_keys_and_they_exist():
    kinds = {model.model_fields["kind"].annotation.__args__[0]: model for model in get_args(AnySegment)}
    assert set(kinds) == set(KEYS)
    for kind, keys in KEYS.items():
        named = {key for words in keys for key in re.findall(r"\w+_\w+|count|steps", words)}
        assert named <= set(kinds[kind].model_fields), kind
