"""[calibration] of a stage file: found from a plant's response, written, read, and used wherever the model is."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import tomlkit
from finite_differences import assert_derivative
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, controller, stage
from sim_truth import truth_about

from hil.lanes.setup import bare_setup
from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError, load, plain
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.core import tick
from pkxyz_ctrl.core.adaptation import COMB, PARAMETERS
from pkxyz_ctrl.design.device_errors import calibrated as learnt_as_calibration
from pkxyz_ctrl.design.identification.calibrate import SenseGain, calibrate, gains
from pkxyz_ctrl.design.identification.modal_fit import FitError, ModalFit
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.stage import Stage, StageDomainError
from pkxyz_ctrl.trajectory import Hold, Move, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import check_against
from pkxyz_ctrl.trajectory.comb_forces import comb_forces
from sim.config import Device, PlantConfig

DRAWN = load("stages", "reconstructed", StageConfig)
COUNT_F = bus().analog.sense_farad_per_count
AS_DRAWN = SenseGain(np.ones(3), np.zeros(3))
ODD = Calibration(
    comb_gain=(1.08, 0.9, 1.05), lift=0.05, sense_gain=(1.02, 0.99, 1.0), slider_stiffness=(1.1, 0.92, 1.06),
    crank_stiffness=(1.1, 1.05, 0.9), link_stiffness=1.08, quality_factor=12.0, sense_delay_s=8e-6,
)  # fmt: skip


def calibrated(numbers: Calibration) -> Stage:
    return Stage(DRAWN.model_copy(update={"calibration": numbers}))


def odd() -> Stage:
    return calibrated(ODD)


# -- the numbers, from a response -----------------------------------------------------------------------------------


def plant_with(**effects):
    """The software plant on a bench that has these effects and no other."""
    on = {name: {"on": True, **values} for name, values in effects.items()}
    config = PlantConfig.model_validate({"name": "odd", **on})
    return dataclasses.replace(bare_setup("reconstructed", "nominal", controller(), bus(), 1), plant=config).new_plant()


def measured(static, acceleration, relative=1e-6) -> ModalFit:
    """As if the modal fit had found these gains."""
    scale = relative * np.repeat([np.abs(static).max(), np.abs(acceleration).max()], 9)
    spread = np.full(3, 1e-4)
    return ModalFit(
        frequency_hz=np.full(3, 600.0), frequency_standard_error_hz=spread, damping=np.full(3, 0.025),
        damping_standard_error=spread, static_gain=static, static_gain_standard_error=scale[:9].reshape(3, 3),
        acceleration_gain=acceleration, acceleration_gain_standard_error=scale[9:].reshape(3, 3),
        gains_covariance=np.diag(scale**2), lag_s=5.3e-6, lag_standard_error_s=1e-7, chi_square=1.0,
        used_hz=(5.0, 1500.0), _coefficients=np.zeros(0), _period_s=200e-6, _delay_periods=1,
    )  # fmt: skip


few = st.floats(-0.1, 0.1)
each = st.tuples(few, few, few).map(np.array)


@settings(max_examples=25)
@given(each, each, each, few, few, st.floats(-0.02, 0.06), each.map(lambda g: 0.1 * g))
def test_the_plants_own_numbers_are_found(comb, leaf, crank, link, mass, lift, sense):
    """From its equations, which share nothing with the fit; relative to its mass, with the sense gains known."""
    crank = crank - crank.mean() + leaf.mean()
    plant = plant_with(
        comb_mismatch={"relative": comb.tolist()}, levitation={"ratio": max(lift, 0.0)},
        stiffness_mismatch={"leaf": leaf.tolist(), "crank_hinge": crank.tolist(), "link_hinge": [link] * 3},
        mass_error={"relative": mass}, sense_gain={"relative": sense.tolist(), "curvature_per_25um": 0.0},
    )  # fmt: skip
    squared_v2 = np.full(3, 130.0**2)
    truth, strokes_m = truth_about(plant, squared_v2, 0.0), strokes_under(plant, squared_v2)
    response = measured(truth.static_gain, truth.acceleration_gain)
    found = calibrate(DRAWN, strokes_m, response, COUNT_F, SenseGain(1.0 + sense, np.full(3, 1e-6)))
    numbers = found.calibration
    assert np.array(numbers.comb_gain) == pytest.approx((1 + comb) / (1 + mass), rel=2e-4)
    assert numbers.lift == pytest.approx(max(lift, 0.0), abs=2e-4)
    assert np.array(numbers.slider_stiffness) == pytest.approx((1 + leaf) / (1 + mass), abs=2e-3)
    assert np.array(numbers.crank_stiffness) == pytest.approx((1 + crank) / (1 + mass), abs=5e-4)
    assert numbers.link_stiffness == pytest.approx((1 + link) / (1 + mass), abs=5e-4)
    assert found.reciprocal.gain == pytest.approx(1 + sense, rel=5e-4)
    assert not found.differ


def strokes_under(plant, squared_v2):
    """Where the plant rests."""
    from sim.motion.geometry import strokes
    from sim.parameters import equilibrium

    p, state = plant.params[0], plant.state.copy()
    state["force_n"] = p["weight_n"]
    q = np.empty(3)
    strokes(p, np.concatenate([equilibrium(plant.params, state, squared_v2), np.zeros(3)]), q)
    return q


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_standard_errors_are_those_of_the_errors(seed):
    """Noise of 0.1 % on what ODD would show: each number within 5 of its standard errors, none absurdly wide."""
    rng = np.random.default_rng(seed)
    clean = gains(odd(), MIDDLE, COUNT_F)
    noisy = clean + 1e-3 * rng.normal(size=clean.shape) * np.abs(clean).max(axis=(1, 2), keepdims=True)
    found = calibrate(DRAWN, MIDDLE, measured(*noisy, 1e-3), COUNT_F, SenseGain(np.array(ODD.sense_gain), np.zeros(3)))
    numbers, errors = found.calibration, found.calibration.standard_error
    common = np.mean(ODD.slider_stiffness) - np.mean(ODD.crank_stiffness)
    assert abs(common) < 0.011  # the fit takes these means alike, so ODD is off by that
    for name in ("comb_gain", "lift", "link_stiffness"):
        off = np.abs(np.array(getattr(numbers, name)) - np.array(getattr(ODD, name)))
        error = np.array(getattr(errors, name))
        assert (off < 5 * error + abs(common)).all()
        assert (error < 0.01).all()


def test_a_sense_channel_that_is_off_is_noticed_from_inside():
    """3 % of one chain's gain: what the combs do to one another's strokes would not be mutual."""
    off = Calibration(sense_gain=(1.03, 1.0, 1.0))
    response = measured(*gains(calibrated(off), MIDDLE, COUNT_F), 1e-3)
    found = calibrate(DRAWN, MIDDLE, response, COUNT_F, AS_DRAWN)
    assert found.differ
    mean = 1.03 ** (1 / 3)
    assert np.array(found.calibration.sense_gain) == pytest.approx(np.array(off.sense_gain) / mean, rel=1e-3)
    assert np.prod(found.calibration.sense_gain) == pytest.approx(1.0, rel=1e-12)
    known = SenseGain(np.ones(3), np.full(3, 1e-4))  # by an instrument: it keeps the last word
    kept = calibrate(DRAWN, MIDDLE, response, COUNT_F, known)
    assert kept.differ
    assert kept.calibration.sense_gain == (1.0, 1.0, 1.0)


def test_another_device_is_refused():
    response = measured(*(20.0 * gains(Stage(DRAWN), MIDDLE, COUNT_F)))
    with pytest.raises(FitError, match="not this drawing: comb_gain"):
        calibrate(DRAWN, MIDDLE, response, COUNT_F, AS_DRAWN)


def test_a_response_that_tells_nothing_of_the_springs_is_refused():
    """As where a fit ran away from them: its normal matrix was singular or not by the machine that inverted it."""
    told = measured(*gains(Stage(DRAWN), MIDDLE, COUNT_F))
    blind = np.where(np.arange(18) < 9, 1e18, 1.0)  # static gains alone tell springs
    with pytest.raises(FitError, match="no springs, no gains answer so"):
        calibrate(DRAWN, MIDDLE, replace(told, gains_covariance=blind * told.gains_covariance), COUNT_F, AS_DRAWN)


# -- what uses them -------------------------------------------------------------------------------------------------


def test_all_ones_is_no_calibration_bit_for_bit():
    stage_as_drawn = calibrated(Calibration())
    for name in ("lqg", "hinf"):
        config = load("controllers", name, type(controller()))
        laws = [design_law(s, config, bus(), autostart=True) for s in (Stage(DRAWN), stage_as_drawn)]
        assert laws[0].tobytes() == laws[1].tobytes()


def test_the_plant_does_not_read_it(tmp_path):
    path = tmp_path / "stage.toml"
    path.write_text(tomlkit.dumps(plain(odd().config)), encoding="utf-8")
    assert load("stages", path, StageConfig).calibration == ODD
    assert Device.load(path) == Device.load(CONFIG_DIR / "stages" / "reconstructed.toml")


def test_each_comb_has_its_own_law():
    device, volts = odd(), np.array([50.0, 120.0, 199.0])
    force = device.comb_force(volts)
    assert force / stage().comb_force(volts) == pytest.approx(np.array(ODD.comb_gain), rel=1e-14)
    assert device.comb_voltage(force) == pytest.approx(volts, rel=1e-14)
    assert device.comb_voltage(device.force_max_n) == pytest.approx(np.full(3, 200.0), rel=1e-15)
    beyond = device.force_max_n * [1.0, 1.01, 1.0]
    with pytest.raises(StageDomainError, match=r"needs 201\.0 V"):
        device.comb_voltage(beyond)
    for of_one in (device.comb_force, device.comb_voltage):
        with pytest.raises(StageDomainError, match=r"must have shape \(\.\.\., 3\), as the combs differ"):
            of_one(1e-6)


def test_each_chain_has_its_own_sense_comb():
    strokes_m = np.array([5e-6, 10e-6, 20e-6])
    changed = odd().sense_capacitance(strokes_m) - odd().sense_capacitance(np.zeros(3))
    assert changed / (stage().sense_gradient_f_per_m * strokes_m) == pytest.approx(np.array(ODD.sense_gain), rel=1e-12)
    assert odd().strokes_from_capacitance(odd().sense_capacitance(strokes_m)) == pytest.approx(strokes_m, abs=5e-20)
    assert odd().sense_capacitance(np.zeros(3)) == pytest.approx(stage().sense_capacitance(np.zeros(3)), rel=1e-15)


@settings(max_examples=30)
@given(st.tuples(st.floats(-8e-6, 8e-6), st.floats(-8e-6, 8e-6), st.floats(0.0, 30e-6)).map(np.array))
def test_springs_of_each_chain_are_one_energy(position_m):
    assert_derivative(odd().potential_energy, odd().energy_gradient, position_m, step=2e-6, rtol=1e-8, floor=1e-4)
    assert_derivative(odd().energy_gradient, odd().stiffness, position_m, step=2e-6, rtol=1e-8)


def test_holding_forces_hold_with_lift():
    at = odd().forward_kinematics(MIDDLE)
    force = odd().holding_forces(at)
    up = np.array([0.0, 0.0, ODD.lift * force.sum()])
    assert odd().jacobian(at).T @ force + up == pytest.approx(odd().energy_gradient(at), rel=1e-12)
    assert odd().comb_force(odd().holding_voltages(at)) == pytest.approx(force, rel=1e-12)


def test_a_tick_reads_strokes_and_sets_voltages_by_it():
    law = design_law(odd(), controller(), bus(), autostart=True)["tick"][0]
    memory = np.zeros(1, tick.MEMORY)[0]
    at = odd().forward_kinematics(MIDDLE)
    tick.set_position(law, memory, at)
    farad = odd().sense_capacitance(MIDDLE)
    analog = bus().analog
    tick.measure(law, memory, np.round((farad - analog.sense_offset_f) / COUNT_F).astype(np.int32))
    assert np.abs(memory["stroke_m"] - MIDDLE).max() < 0.6 * COUNT_F / odd().sense_gradient_f_per_m.min()
    row = np.concatenate([at, np.zeros(6)])
    for _ in range(400):  # slewing there
        tick.estimate(law, memory, True)
        tick.act(law, memory, row, row, row)
        tick.set_position(law, memory, at)
    volts = memory["count"][0] * analog.drive_volt_per_count
    assert volts == pytest.approx(odd().holding_voltages(at), abs=2 * analog.drive_volt_per_count)
    assert memory["slack_n"] == pytest.approx(np.zeros(3), abs=1e-9)


def test_a_reference_is_checked_against_each_combs_own_limit():
    """A comb at a quarter of its pull needs twice the voltage."""
    weak = calibrated(Calibration(comb_gain=(1.0, 0.3, 1.0)))
    top = weak.forward_kinematics(MIDDLE)
    hold = Trajectory([
        Move(kind="move", to_m=(0.0, 0.0, float(top[2])), velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=0.1,
             jerk_max_m_per_s3=1e2),
        Hold(kind="hold", duration_s=0.01),
    ])  # fmt: skip
    check_against(stage(), hold)
    with pytest.raises(TrajectoryError, match="comb 2 would need 2"):
        check_against(weak, hold)
    row = np.concatenate([top, np.zeros(6)])[None]
    assert comb_forces(odd(), row)[0] == pytest.approx(odd().holding_forces(top), rel=1e-12)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"comb_gain": [1.0, 1.0]}, "calibration.comb_gain"),
        ({"comb_gain": [1.0, 1.0, 0.0]}, "greater than 0.1"),
        ({"gain": [1.0, 1.0, 1.0]}, "unknown key"),
        ({"lift": 0.7}, "less than 0.5"),
        ({"standard_error": {"lift": 0.1}}, "calibration.standard_error.comb_gain: missing"),
    ],
)
def test_the_section_is_strict(tmp_path, keys, words):
    path = tmp_path / "stage.toml"
    path.write_text(tomlkit.dumps(plain(DRAWN) | {"calibration": keys}), encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        Stage.load(path)


@given(st.lists(st.floats(-0.35, 0.35), min_size=3, max_size=3))
def test_a_comb_of_which_less_is_asked_pulls_by_so_much_more(less):
    """What was learnt scales what is asked of a comb; a device of the calibrated gain then gives what was meant."""
    values = np.zeros(PARAMETERS)
    values[COMB : COMB + 3] = less
    found = learnt_as_calibration(DRAWN, values).calibration
    assert found is not None
    assert np.array(found.comb_gain) * (1.0 - np.array(less)) == pytest.approx(np.ones(3), rel=1e-12)
