"""The check before a run: forces by hand, every limit at its edge, the first instant named."""

import numpy as np
import pytest

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import names
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Circle, Hold, Move, Sine, Steps, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import DriveLimits, check_against, comb_forces

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
    named_us = round(float(str(refused.value).split(": ")[1].split(" s after")[0]) * 1e6)
    change = np.abs(voltage[lag:] - voltage[:-lag]).max(axis=1) / (period_us * 1e-6)
    first_us = (np.argmax(change > fastest * 0.99) + lag) * 10
    assert named_us == pytest.approx(first_us, abs=150), "to a sample and four digits of the time"


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
    with pytest.raises(TrajectoryError, match=r"reference\.1 \(steps\): .*stroke \d would be"):
        check_against(STAGE, jumping(20.0), drive())


@pytest.mark.parametrize("name", names("scenarios"))
def test_every_shipped_scenario_loads_and_its_reference_can_be_followed(name):
    scenario = load_scenario(name)
    assert scenario.config.name == name
    end_s = scenario.trajectory.duration_us * 1e-6
    assert end_s + scenario.controller.homing_s + 0.05 < scenario.config.duration_s < end_s + 0.3
