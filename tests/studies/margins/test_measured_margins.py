"""Sensitivity measured in the running loop against the computed one: noise alone may explain the difference."""

import dataclasses
import json
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, law, setup, stage
from typer.testing import CliRunner

from hil.cli import app
from hil.lanes.excitation import excitation, tones
from hil.lanes.lane import Lane
from hil.studies.margins.excited import MeasurementError, at_point
from hil.studies.margins.loop import Loop, agreement, as_json, over_changed_plants
from hil.studies.margins.measured import measure, sampled_margins
from pkxyz_ctrl.config.files import ConfigError, load, parse, plain
from pkxyz_ctrl.core.demand import LINEAR
from pkxyz_ctrl.design.law_about import law_about
from pkxyz_ctrl.design.margins.margins import frequency_grid_hz, margins, peak_sensitivity
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation, loop_plant
from sim.config import PlantConfig

OFF_CENTRE = np.array([7e-6, 15e-6, 11e-6])
PERIODS = 5


def loop():
    return Loop(stage(), bus(), law())


def wide():
    return load("tolerances", "wide", Tolerances)


def plant_with(**effects):
    """The nominal plant with other effects."""
    data = plain(setup().plant) | {name: {"on": True, **values} for name, values in effects.items()}
    return PlantConfig.model_validate(json.loads(json.dumps(data)))


@cache
def measured(kind="multisine", combs=(0.0, 0.0, 0.0)):
    """On the default scenario's stage and bus, off the centre."""
    period = 2500 if kind == "multisine" else 500
    added = excitation(
        kind, tones(period, 40 if kind == "multisine" else 6, 3), period_ticks=period, periods=PERIODS,
        amplitude_m=8e-9, first_tick=0, seed=3,
    )  # fmt: skip
    run = dataclasses.replace(setup(), plant=plant_with(comb_mismatch={"relative": list(combs)}))
    return measure(at_point(run, OFF_CENTRE, added), Lane.FAST)


@pytest.mark.parametrize("kind", ["multisine", "stepped"])
def test_measured_and_computed_sensitivity_differ_by_noise_alone(kind):
    """All nine entries at all tones; the mean square distance is that of the distribution, so no bias hides in it."""
    seen = measured(kind)
    compared = agreement(seen, loop().response(OFF_CENTRE, seen.frequency_hz))
    assert compared.holds
    entries = seen.s.size
    spread = 4.0 / np.sqrt(entries)  # four standard errors of a mean of F(2, 8), whose standard deviation is below 2
    assert abs(compared.mean_square - compared.expected_mean_square) < 2.0 * spread
    assert compared.largest_difference < 0.05


def test_a_plant_that_is_not_the_computed_one_is_noticed_and_is_the_changed_one():
    """Combs 10 % off: disagrees with the drawing, agrees with the perturbation that says so."""
    seen = measured(combs=(0.1, -0.1, 0.1))
    assert not agreement(seen, loop().response(OFF_CENTRE, seen.frequency_hz)).holds
    changed = Perturbation(comb_gain=(0.1, -0.1, 0.1))
    compared = agreement(seen, loop().response(OFF_CENTRE, seen.frequency_hz, changed))
    assert compared.holds


def test_measured_margins_are_the_computed_ones():
    found, computed = measured().margins(), loop().margins(OFF_CENTRE)
    assert found.mimo.peak_s == pytest.approx(computed.mimo.peak_s, rel=0.03)
    assert found.mimo.disk_margin == pytest.approx(computed.mimo.disk_margin, rel=0.05)
    assert found.mimo.bandwidth_hz == pytest.approx(computed.mimo.bandwidth_hz, rel=0.04)
    for seen, expected in zip(found.axes, computed.axes, strict=True):
        assert seen.peak_s == pytest.approx(expected.peak_s, rel=0.03)
        assert seen.gain_margin == pytest.approx(expected.gain_margin, rel=0.05)
        assert seen.phase_margin_rad == pytest.approx(expected.phase_margin_rad, rel=0.05)
        assert seen.delay_margin_s == pytest.approx(expected.delay_margin_s, rel=0.06)


def test_margins_of_a_sampled_response_are_those_of_the_function():
    """Without noise, on the tones of the command."""
    f = tones(5000, 120).astype(float)
    found, exact = sampled_margins(f, loop().response(MIDDLE, f).s), loop().margins(MIDDLE)
    assert found.mimo.peak_s == pytest.approx(exact.mimo.peak_s, rel=2e-3)
    assert found.mimo.bandwidth_hz == pytest.approx(exact.mimo.bandwidth_hz, rel=2e-3)
    assert found.axes[0].phase_margin_rad == pytest.approx(exact.axes[0].phase_margin_rad, rel=5e-3)


def test_a_loop_that_opens_while_it_is_measured_is_no_measurement():
    """Steps of a micrometre are no innovation that a monitor lets pass."""
    added = excitation(
        "multisine", np.array([200, 240]), period_ticks=500, periods=3, amplitude_m=1e-6, first_tick=0, seed=1
    )
    with pytest.raises(MeasurementError, match="opened while it was measured"):
        measure(at_point(setup(), MIDDLE, added), Lane.FAST)
    with pytest.raises(ValueError, match="without an excitation"):
        measure(setup(), Lane.FAST)


# -- changed plants ---------------------------------------------------------------------------------------------------


def test_the_points_can_be_held_even_by_a_stiffer_stage_with_weaker_combs():
    tolerances, v_max = wide(), stage().voltage_max_v
    for strokes in tolerances.points_m().values():
        volts = stage().holding_voltages(stage().forward_kinematics(strokes))
        assert volts.min() > 10.0
        assert volts.max() * np.sqrt(1 + tolerances.stiffness) < v_max
        assert volts.max() / np.sqrt(1 - tolerances.comb_gain) < v_max


def test_cases_are_every_change_at_every_point_with_names_that_tell_them_apart():
    cases = wide().cases()
    assert len(cases) == len({case.name for case in cases}) == 9 * 15
    assert cases[0].perturbation == NOMINAL
    assert cases[0].strokes_m == pytest.approx(MIDDLE)


@settings(max_examples=200)
@given(st.integers(0, 2**32 - 1))
def test_what_is_sampled_lies_within_the_tolerances_and_is_the_same_again(seed):
    t = wide()
    case, again = t.sample(seed), t.sample(seed)
    assert case.perturbation == again.perturbation
    assert np.array_equal(case.strokes_m, again.strokes_m)
    p = case.perturbation
    assert abs(p.stiffness) <= t.stiffness
    assert abs(p.mass) <= t.mass
    assert t.quality_factor[0] <= p.quality_factor <= t.quality_factor[1]
    assert max(map(abs, p.comb_gain)) <= t.comb_gain
    assert t.stroke_low_m <= case.strokes_m.min() <= case.strokes_m.max() <= t.stroke_high_m


def test_tolerances_that_contradict_themselves_are_refused():
    for key, value, words in (
        ("stroke_high_m", 2e-6, "must be below"),
        ("quality_factor", [20.0, 5.0], "least, greatest"),
        ("stiffness", 1.0, "less than 1"),
    ):
        with pytest.raises(ConfigError, match=words):
            parse(plain(wide()) | {key: value}, Tolerances, "file")


def test_peak_sensitivity_is_the_one_of_all_margins():
    for case in wide().cases()[::19]:
        p, k = (
            loop_plant(stage(), bus(), case.strokes_m, case.perturbation),
            law_about(stage(), law(), case.strokes_m, case.perturbation),
        )
        assert peak_sensitivity(p, k) == pytest.approx(margins(p, k).mimo.peak_s, rel=1e-3)
        assert len(frequency_grid_hz(p, k, 300)) > 300


def test_the_worst_of_the_changed_plants_is_found():
    cases = [c for c in wide().cases() if c.name.endswith("middle")]
    found = over_changed_plants(loop(), cases)
    case, peak = found.worst
    assert peak == max(found.peak_s)
    assert case.name == "stiffness -20%, middle"
    assert 1.9 < peak < 2.2


def test_a_linear_law_is_read_from_the_numbers_of_the_tick():
    """Its matrices as they stand; half of them where the combs' least force gives half the authority."""
    numbers = law().copy()
    linear = numbers["tick"]["linear"][0]
    rng = np.random.default_rng(1)
    n, a, b, c, d = 4, *(rng.normal(size=shape) for shape in ((4, 4), (4, 3), (3, 4), (3, 3)))
    numbers["tick"]["kind"], linear["order"] = LINEAR, n
    linear["a"][:n, :n], linear["b"][:n], linear["c"][:, :n], linear["d"] = a, b, c, d
    found = law_about(stage(), numbers, MIDDLE)
    assert np.array_equal(found.a, a)
    assert np.array_equal(found.b, b)
    assert np.array_equal(found.c, c)
    assert np.array_equal(found.d, d)
    least = stage().holding_forces(stage().forward_kinematics(MIDDLE)).min()
    numbers["tick"]["feedback"]["authority_force_n"] = 2 * least
    assert law_about(stage(), numbers, MIDDLE).c == pytest.approx(c / 2)


# -- the command ------------------------------------------------------------------------------------------------------


def run_command(*arguments):
    return CliRunner().invoke(app, ["margins", *arguments])


def test_the_command_prints_what_was_computed_and_writes_pictures(tmp_path):
    done = run_command("--controller", "lqg_wide", "--json", "--out", str(tmp_path / "new"))
    assert done.exit_code == 0, done.output
    data = json.loads(done.stdout)
    from pkxyz_ctrl.config.controller import ControllerConfig
    from pkxyz_ctrl.design.law import design_law

    wide_law = design_law(stage(), load("controllers", "lqg_wide", ControllerConfig), bus(), autostart=True)
    assert data["computed"] == as_json(Loop(stage(), bus(), wide_law).margins(MIDDLE))
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["bode.png", "margins.json", "nyquist.png"]
    assert json.loads((tmp_path / "new" / "margins.json").read_text()) == data


def test_a_law_without_a_loop_has_no_margins():
    done = run_command("--controller", "open_loop")
    assert isinstance(done.exception, ConfigError)
    assert "only feeds forward" in str(done.exception)


def test_no_frames_no_lockstep():
    done = run_command("--bus", "local_20k", "--measured", "--lane", "lockstep")
    assert isinstance(done.exception, ConfigError)
    assert "--lane fast" in str(done.exception)
