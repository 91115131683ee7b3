"""Linear laws chosen in a controller file: what is asked for is what runs, it is checked first, and it does not wind
up while the combs can't give what it asks for."""

import dataclasses

import control
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, controller, first_difference, rows_of, setup, shortened, stage

from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError, load, parse, plain, read_toml, write_toml
from pkxyz_ctrl.core import linear_law
from pkxyz_ctrl.core.demand import LINEAR
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about
from pkxyz_ctrl.design.laws.chosen_law import at_authority, chosen_law, unwinding, with_law
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.safety.modes import Mode

SHIPPED = ("pi_notch", "irc", "hinf")
STIFF = 73.0
PERIOD = 200e-6


def shipped(name):
    return load("controllers", name, ControllerConfig)


def plant():
    return loop_plant(stage(), bus(), shipped("lqg").operating_strokes_m)


def run_setup(controller_config, plant_name="nominal"):
    return dataclasses.replace(setup(plant_name), controller=controller_config)


def integrator(gain=200.0):
    return control.tf([STIFF * gain], [1.0, 0.0])


def data_of(name):
    return read_toml(CONFIG_DIR / "controllers" / f"{name}.toml")


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_what_is_designed_is_what_runs(name):
    law, found = chosen_law(stage(), shipped(name), bus())
    record = design_law(stage(), shipped(name), bus(), autostart=True)["tick"]
    linear, n = record["linear"][0], law.order
    assert record["kind"][0] == LINEAR
    assert linear["order"] == n
    for key in ("a", "b", "c", "d"):
        matrix = getattr(law, key)
        assert np.array_equal(linear[key][: matrix.shape[0], : matrix.shape[1]], matrix)
    assert np.array_equal(linear["unwind"][:n], unwinding(law, plant()))
    assert found.stable


@pytest.mark.parametrize("name", SHIPPED)
def test_the_section_of_the_law_has_to_be_there_and_no_other(name):
    data = data_of(name)
    section = data.pop(name)
    with pytest.raises(ConfigError, match=rf"x.toml: file: law = \"{name}\" needs a section \[{name}\]; add it"):
        parse(data, ControllerConfig, "x.toml")
    with pytest.raises(ConfigError, match=rf"section \[{name}\] belongs to law = \"{name}\", not to \"lqg\"; remove"):
        parse(data | {name: section, "law": "lqg"}, ControllerConfig, "x.toml")


def linear_data(**linear):
    return data_of("lqg") | {"law": "linear", "linear": linear}


def linear_config(**linear):
    return parse(linear_data(**linear), ControllerConfig, "x.toml")


AXIS = {"numerator": [STIFF * 200.0], "denominator": [1.0, 0.0]}


@pytest.mark.parametrize(
    ("linear", "reason"),
    [
        ({}, r"give the law either by \[\[linear.axis\]\] or by \[linear.matrices\]"),
        ({"axis": [AXIS, AXIS]}, "not 2 times"),
        ({"axis": [AXIS], "method": "euler"}, "linear.method"),
        ({"axis": [{"numerator": [], "denominator": [1.0]}]}, "linear.axis.0.numerator"),
    ],
)
def test_a_file_that_describes_no_law_is_refused(linear, reason):
    with pytest.raises(ConfigError, match=reason):
        linear_config(**linear)


ROW3 = [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("linear", "reason"),
    [
        ({"axis": [{"numerator": [1.0, 0.0, 0.0], "denominator": [1.0, 0.0]}]}, "more zeros than poles"),
        ({"axis": [{"numerator": [1.0], "denominator": [0.0]}]}, "denominator is zero"),
        ({"axis": [AXIS], "period_us": 500}, "period_us is 500 and the bus has 200 us"),
        ({"axis": [{**AXIS, "numerator": [-STIFF * 200.0]}]}, "with its sign turned round it is stable"),
        ({"axis": [{**AXIS, "numerator": [STIFF * 2000.0]}]}, "with a tenth of its gain it is stable"),
        ({"matrices": {"a": [[0.0]], "b": [ROW3], "c": [[1.0]], "d": [ROW3] * 3}}, "c has to be 3 rows of 1 numbers"),
        ({"matrices": {"a": [], "b": [], "c": [[], [], []], "d": [[0.0]] * 3}}, "d has to be 3 rows of 3 numbers"),
    ],
)
def test_a_law_that_the_stage_could_not_bear_is_refused_before_it_runs(linear, reason):
    with pytest.raises(ConfigError, match=rf"controller 'lqg': law 'linear': .*{reason}"):
        design_law(stage(), linear_config(**linear), bus(), autostart=True)


def test_too_little_delay_margin_is_refused():
    """Tuned to 0.3 dB from its limit the baseline is stable, but not if the loop takes a quarter of a period longer."""
    near = parse(data_of("pi_notch") | {"pi_notch": {"gain_margin_db": 0.3}}, ControllerConfig, "x.toml")
    with pytest.raises(ConfigError, match=r"us of additional delay, and 50\.0 us are asked for"):
        design_law(stage(), near, bus(), autostart=True)


def test_a_file_and_one_call_of_python_give_the_same_law(tmp_path):
    """Once for every axis, three times, as matrices, sampled before: one law. And it survives being written."""
    whole = control.append(*[control.ss(integrator())] * 3)
    from_python = with_law(controller(), whole)
    write_toml(plain(from_python), tmp_path / "mine.toml")
    again = load("controllers", tmp_path / "mine.toml", ControllerConfig)
    assert again == from_python
    configs = [from_python, with_law(controller(), integrator()), linear_config(axis=[AXIS])]
    configs += [linear_config(axis=[AXIS] * 3), again]
    z = np.exp(1j * np.array([0.01, 0.3, 2.0]))
    responses = []
    for config in configs:
        law, _ = chosen_law(stage(), config, bus())
        responses.append(np.array([law.c @ np.linalg.solve(p * np.eye(law.order) - law.a, law.b) + law.d for p in z]))
    for other in responses[1:]:
        assert other == pytest.approx(responses[0], rel=1e-9)
    law, _ = chosen_law(stage(), from_python, bus())
    sampled = with_law(controller(), control.ss(law.a, law.b, law.c, law.d, PERIOD))
    assert sampled.linear is not None
    assert sampled.linear.period_us == 200
    assert np.array_equal(chosen_law(stage(), sampled, bus())[0].a, law.a)
    assert with_law(shipped("hinf"), integrator()).hinf is None


@pytest.mark.parametrize(
    ("system", "reason"),
    [
        (3.0, "of python-control, not float"),
        (control.tf([1.0], [1.0, 1.0], True), "does not say which period"),
        (control.tf([1.0], [1.0, 1.0], 200.5e-6), "whole number of microseconds"),
        (control.ss(np.eye(2), np.eye(2), np.eye(2), 0.0), "one input and one output"),
    ],
)
def test_what_is_no_law_is_refused(system, reason):
    with pytest.raises(LawError, match=reason):
        with_law(controller(), system)


# -- winding up -------------------------------------------------------------------------------------------------------


@st.composite
def laws(draw):
    """Laws of up to four states, integrators and unstable ones among them, with states of all sizes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    order = draw(st.integers(1, 4))
    a = rng.normal(size=(order, order))
    a *= draw(st.sampled_from([0.5, 1.0, 1.05])) / np.abs(np.linalg.eigvals(a)).max()
    sizes = 10.0 ** rng.uniform(-3, 3, order)
    b, c = rng.normal(size=(order, 3)), rng.normal(size=(3, order)) * STIFF
    d = draw(st.sampled_from([0.0, 1.0])) * STIFF * np.eye(3)
    return DiscreteLaw(PERIOD, a * sizes[:, None] / sizes, b * sizes[:, None], c / sizes, d)


@settings(max_examples=60)
@given(laws())
def test_without_authority_every_law_comes_to_rest(law):
    """A - U C, which is what is left of a law none of whose force is given, forgets; unstable laws do so too."""
    left = law.a - unwinding(law, plant()) @ law.c
    assert np.abs(np.linalg.eigvals(left)).max() < 1.0


def test_where_there_is_much_feedthrough_it_is_hanus():
    """A law with zeros inside the unit circle and a large D: the state in which it would have given what was given."""
    a, b, c, d = np.diag([1.0, 0.9, 0.5]), np.eye(3), STIFF * np.eye(3), 1e3 * STIFF * np.eye(3)
    law = DiscreteLaw(PERIOD, a, b, c, d)
    assert unwinding(law, plant()) == pytest.approx(b @ np.linalg.inv(d), rel=1e-3)


@settings(max_examples=40)
@given(laws(), st.floats(0.0, 1.0), st.integers(0, 2**32 - 1))
def test_the_kernel_is_the_law_at_that_authority(law, share, seed):
    """Ten steps of the compiled law against numpy."""
    rng = np.random.default_rng(seed)
    unwind, n = unwinding(law, plant()), law.order
    record, state = np.zeros(1, linear_law.LINEAR_LAW)[0], np.zeros(1, linear_law.LINEAR_STATE)[0]
    record["a"][:n, :n], record["b"][:n], record["c"][:, :n], record["d"] = law.a, law.b, law.c, law.d
    record["unwind"][:n], record["order"] = unwind, n
    x, seen_law = np.zeros(n), at_authority(law, unwind, share)
    for _ in range(10):
        expected, out = rng.normal(size=3), np.zeros(3)
        seen = expected + 1e-9 * rng.normal(size=3)
        error = seen - expected
        linear_law.add_feedback(record, state, seen, expected, share, out)
        assert out == pytest.approx(-(seen_law.c @ x + seen_law.d @ error), rel=1e-9, abs=1e-15)
        linear_law.advance(record, state, share)
        x = seen_law.a @ x + seen_law.b @ error
        assert state["x"][:n] == pytest.approx(x, rel=1e-6, abs=1e-9 * np.abs(x).max())
    linear_law.clear(state)
    assert not state["x"].any()


@pytest.mark.parametrize("name", SHIPPED)
def test_a_law_takes_over_without_a_jump(name):
    """The mild plant stands at rest for 20 ms without authority, some nm beside its reference, then moves off: the
    largest error on the way is that of a model some per cent off, and there is no fault."""
    rows, result = rows_of(shortened(run_setup(shipped(name), "mild"), 1000), "fast")
    moving = rows[(rows["mode"] == Mode.TRACKING) & (rows["reference_tick"] > 100)]
    assert len(moving) > 500
    assert np.abs(moving["position_m"] - moving["reference_m"]).max() < 40e-9
    assert result.faults == ()


@pytest.mark.parametrize("name", SHIPPED)
def test_a_constant_error_without_authority_is_not_summed_up(name):
    """50 nm that nobody can take away: after a second the law asks for what it asked for after 0.1 s, and would ask for
    about ten times as much if it were not told that it gets nothing."""
    law, _ = chosen_law(stage(), shipped(name), bus())
    asked = []
    for unwind in (unwinding(law, plant()), np.zeros((law.order, 3))):
        a, b = law.a - unwind @ law.c, law.b - unwind @ law.d
        x, error = np.zeros(law.order), np.full(3, 50e-9)
        for tick in range(5000):
            x = a @ x + b @ error
            if tick in (499, 4999):
                asked.append(np.linalg.norm(law.c @ x + law.d @ error))
    assert asked[1] == pytest.approx(asked[0], rel=1e-3)
    assert 9.0 < asked[3] / asked[2] < 11.0
    assert asked[3] > 20.0 * asked[1]


# -- the loop ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*SHIPPED, "linear"])
def test_both_lanes_have_the_same_bits(name):
    """Homing, fading in, the move to the middle of the workspace and part of the scan."""
    config = with_law(controller(), integrator()) if name == "linear" else shipped(name)
    short = shortened(run_setup(config, "mild"), 2200)
    fast, result = rows_of(short, "fast")
    lockstep, _ = rows_of(short, "lockstep")
    assert first_difference(fast, lockstep) is None
    assert result.faults == ()
    assert fast["mode"][-1] == Mode.TRACKING


@pytest.mark.parametrize(("name", "low_nm", "high_nm"), [("pi_notch", 0.8, 2.0), ("irc", 0.7, 1.6), ("hinf", 0.8, 2.2)])
def test_error_on_the_default_scan(name, low_nm, high_nm):
    """Nominal plant, true position: sensor noise of 2 nm a sample through a loop of 60 to 150 Hz."""
    rows, result = rows_of(run_setup(shipped(name)), "fast")
    scan = rows[(rows["t_us"] > 0.35e6) & (rows["t_us"] < 0.9e6)]
    rms_nm = np.sqrt(np.mean((scan["position_m"] - scan["reference_m"]) ** 2, axis=0)) * 1e9
    assert (rms_nm > low_nm).all()
    assert (rms_nm < high_nm).all()
    assert not rows["saturated"].any()
    assert result.faults == ()


def test_the_hold_noise_is_the_calculated_one():
    """The loop's noise as the variances of ``hold_noise`` have it, within the statistics of 0.08 s."""
    from pkxyz_ctrl.design.hold_noise import hold_noise_m

    law = design_law(stage(), shipped("pi_notch"), bus(), autostart=True)
    expected = hold_noise_m(stage(), bus(), plant(), law_about(stage(), law, MIDDLE))
    rows, _ = rows_of(run_setup(shipped("pi_notch")), "fast")
    still = rows[(rows["t_us"] > 1.0e6)]
    assert still["position_m"].std(axis=0) == pytest.approx(expected, rel=0.25)


def test_the_block_diagonal_of_nothing_is_a_gain():
    """A law without states: a gain on every axis is a law, too."""
    config = with_law(controller(), control.tf([STIFF * 0.05], [1.0], PERIOD))
    law, _ = chosen_law(stage(), config, bus())
    assert law.order == 0
    assert np.array_equal(law.d, scipy.linalg.block_diag(*[STIFF * 0.05] * 3))
    assert design_law(stage(), config, bus(), autostart=True)["tick"]["linear"]["order"] == 0
