"""Laws that are designed offline: what they promise, checked on the sampled, delayed plant by other means."""

import control
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, stage

from pkxyz_ctrl.design.laws import irc as irc_design
from pkxyz_ctrl.design.laws.irc import Irc, irc
from pkxyz_ctrl.design.laws.pi_notch import PiNotch, mode_frequencies_hz, pi_notch
from pkxyz_ctrl.design.laws.user_law import UnstableLawError, discrete_law, user_law
from pkxyz_ctrl.design.margins.margins import margins, spectral_radius
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, discretise, response, stack
from pkxyz_ctrl.design.model.loop_plant import loop_plant

PERIOD = 200e-6
MASS = stage().config.dynamics.mass_kg
STIFF = 73.0


def plant(bus_name="fd_5k", strokes_m=MIDDLE, delay_periods=1):
    return loop_plant(stage(), bus(bus_name, delay_periods), strokes_m)


def scaled(law, factor):
    return DiscreteLaw(law.period_s, law.a, law.b, factor * law.c, factor * law.d)


def integrator(gain):
    return control.tf([gain], [1.0, 0.0])


# -- DiscreteLaw ------------------------------------------------------------------------------------------------------


def test_a_law_is_read_only_and_its_own_copy():
    a = np.zeros((2, 2))
    law = DiscreteLaw(PERIOD, a, np.zeros((2, 3)), np.zeros((3, 2)), np.eye(3))
    a[0, 0] = 1.0
    assert law.a[0, 0] == 0.0
    assert law.order == 2
    for matrix in (law.a, law.b, law.c, law.d):
        with pytest.raises(ValueError, match="read-only"):
            matrix[0, 0] = 1.0


@pytest.mark.parametrize("order", [0, 1, 24, 25])
def test_there_is_room_for_24_states(order):
    matrices = np.zeros((order, order)), np.zeros((order, 3)), np.zeros((3, order)), np.zeros((3, 3))
    if order <= 24:
        assert DiscreteLaw(PERIOD, *matrices).order == order
    else:
        with pytest.raises(LawError, match="25 states and the tick has room for 24"):
            DiscreteLaw(PERIOD, *matrices)


@pytest.mark.parametrize("name", ["a", "b", "c", "d"])
@pytest.mark.parametrize("bad", ["shape", "nan"])
def test_wrong_matrices_are_named(name, bad):
    matrices = {"a": np.zeros((2, 2)), "b": np.zeros((2, 3)), "c": np.zeros((3, 2)), "d": np.zeros((3, 3))}
    if bad == "nan":
        matrices[name][0, 0] = np.nan
    else:
        matrices[name] = np.zeros((2, 5))
    with pytest.raises(LawError, match=f"matrix {name} of the law"):
        DiscreteLaw(PERIOD, **matrices)


@settings(max_examples=30)
@given(st.floats(0.01, 2.0), st.floats(100.0, 8000.0), st.sampled_from(["tustin", "zoh"]))
def test_sampling_is_scipys_and_prewarping_exact(zeta, w, method):
    system = control.ss(control.tf([w, w * w], [1.0, 2 * zeta * w, w * w]))
    sampled = discretise(system, PERIOD, method)
    a, b, c, d, _ = scipy.signal.cont2discrete(
        (system.A, system.B, system.C, system.D), PERIOD, "bilinear" if method == "tustin" else "zoh"
    )
    z = np.exp(1j * np.linspace(0.01, 3.0, 20))
    assert response(sampled.A, sampled.B, sampled.C, sampled.D, z) == pytest.approx(response(a, b, c, d, z), rel=1e-9)
    warped = discretise(system, PERIOD, "tustin", w)
    assert warped(np.exp(1j * w * PERIOD)) == pytest.approx(system(1j * w), rel=1e-9)


def test_sampling_methods_that_do_not_exist():
    system = control.ss(integrator(1.0))
    for arguments in (("euler", None), ("zoh", 100.0), ("tustin", 1e6)):
        with pytest.raises(LawError):
            discretise(system, PERIOD, *arguments)


def test_stacked_axes_do_not_see_each_other():
    axes = [discretise(control.ss(control.tf([k, 1.0], [1.0, 10.0 * k])), PERIOD) for k in (1.0, 2.0, 3.0)]
    law = stack(PERIOD, axes)
    z = np.exp(1j * np.linspace(0.1, 3.0, 7))
    whole = response(law.a, law.b, law.c, law.d, z)
    for i in range(3):
        assert whole[:, i, i] == pytest.approx(axes[i](z), rel=1e-12)
        assert not np.delete(whole[:, i, :], i, axis=1).any()


# -- PI and notches ---------------------------------------------------------------------------------------------------


@settings(max_examples=8)
@given(st.floats(3.0, 12.0), st.floats(0.0, 400e-6), st.floats(0.3, 1.0), st.sampled_from(["fd_5k", "classic_2k"]))
def test_pi_notch_has_the_gain_margin_that_was_asked_for(margin_db, integral_time_s, damping, bus_name):
    """On the whole plant, by its eigenvalues: stable just below the margin and not just above it."""
    config = PiNotch(gain_margin_db=margin_db, integral_time_s=integral_time_s, notch_damping=damping)
    law, margin = pi_notch(plant(bus_name), MASS, config), 10 ** (margin_db / 20)
    assert spectral_radius(plant(bus_name), scaled(law, margin * 0.9999)) < 1.0
    assert spectral_radius(plant(bus_name), scaled(law, margin * 1.0001)) > 1.0
    assert all(axis.gain_margin == pytest.approx(margin, rel=1e-6) for axis in margins(plant(bus_name), law).axes)


def test_notches_stand_on_the_modes_under_the_holding_forces():
    """618 Hz and 777 Hz at mid-workspace: held combs take away 4 % of the in-plane stiffness."""
    low, high = mode_frequencies_hz(plant(), MASS)
    assert low == pytest.approx(618.6, abs=0.5)
    assert high == pytest.approx(777.5, abs=0.5)
    law, bare = pi_notch(plant(), MASS), discretise(control.ss(control.tf([200e-6, 1.0], [1.0, 0.0])), PERIOD)
    z = np.exp(2j * np.pi * PERIOD * np.array([low, high, 1.0]))
    shape = np.abs(response(law.a, law.b, law.c, law.d, z)[:, 0, 0] / bare(z))
    # at its centre a notch leaves 1 / (2 zeta Q); the other one is not far
    assert (shape[:2] / shape[2] < 1 / (2 * 0.7 * 20)).all()
    assert (shape[:2] / shape[2] > 0.2 / (2 * 0.7 * 20)).all()


def test_pi_notch_off_the_centre():
    """Away from the threefold axis the axes are coupled; the axis designs hold there all the same."""
    off = plant(strokes_m=np.array([6e-6, 16e-6, 11e-6]))
    found = margins(off, pi_notch(off, MASS))
    assert found.stable
    assert 1.9 < min(axis.gain_margin for axis in found.axes) <= 2.05


# -- integral resonant control ----------------------------------------------------------------------------------------


def test_irc_damps_as_the_root_locus_says():
    """From 1/40 to a damping ratio of 0.2 to 0.5 with 300 us of delay, and more gain or less damps less."""
    for axis in (plant().axis(0), plant().axis(2)):
        law, ratio = irc_design.damping_law(axis, Irc())
        assert irc_design.least_damping(axis, 0 * law) == pytest.approx(1 / 40, rel=0.1)
        assert 0.15 < ratio < 0.5
        corner = 2 / PERIOD * (1 - law.A[0, 0]) / (1 + law.A[0, 0])
        for factor in (0.7, 1.4):
            other = factor * corner
            compliance = 1 / axis.stiffness_n_per_m[0, 0]
            changed = discretise(control.ss(control.tf([other / 3 / compliance], [1.0, other])), PERIOD)
            assert irc_design.least_damping(axis, changed) < ratio


def test_irc_is_the_two_loops_that_it_is_made_of():
    """Damping and tracking loop, closed one after the other by python-control, have the poles of the one law."""
    axis, law = plant().axis(0), irc(plant())
    damping, _ = irc_design.damping_law(axis, Irc())
    z = np.exp(1j * np.linspace(0.05, 3.0, 40))
    composed = response(law.a[:2, :2], law.b[:2, :1], law.c[:1, :2], law.d[:1, :1], z)[:, 0, 0]
    tracking = composed / damping(z) + 1.0
    shape = discretise(control.ss(control.tf([100e-6, 1.0], [1.0, 0.0])), PERIOD)(z)
    assert np.ptp((tracking / shape).real) < 1e-6 * np.abs(tracking / shape).max()
    assert np.abs((tracking / shape).imag).max() < 1e-6 * np.abs(tracking / shape).max()
    gain = (tracking / shape).real.mean()
    p = control.ss(axis.a, axis.b, axis.c, 0.0, PERIOD)
    inner = control.feedback(control.ss(damping) * p, 1, sign=1)  # y over -v
    t = shape * gain * inner(z)
    assert t / (1 + t) == pytest.approx(
        (composed * p(z) + damping(z) * p(z)) / (1 + composed * p(z)), rel=1e-6, abs=1e-9
    )


@pytest.mark.parametrize("bus_name", ["fd_5k", "local_20k"])
def test_irc_has_its_gain_margin(bus_name):
    found = margins(plant(bus_name), irc(plant(bus_name)))
    assert found.stable
    assert min(axis.gain_margin for axis in found.axes) == pytest.approx(10 ** (6 / 20), rel=1e-3)
    assert found.mimo.bandwidth_hz > 40.0


def test_irc_is_refused_where_the_delay_is_too_long():
    with pytest.raises(LawError, match="does not damp this axis"):
        irc(plant("classic_2k"))
    with pytest.raises(LawError, match="feedthrough must be above 1"):
        irc(plant(), Irc(feedthrough=0.9))


# -- the user's own ---------------------------------------------------------------------------------------------------


def test_one_transfer_function_serves_every_axis():
    law, found = user_law(integrator(STIFF * 200), plant())
    assert found.stable
    z = np.exp(1j * np.array([0.1, 1.0]))
    expected = discretise(control.ss(integrator(STIFF * 200)), PERIOD)(z)
    values = response(law.a, law.b, law.c, law.d, z)
    for i in range(3):
        assert values[:, i, i] == pytest.approx(expected, rel=1e-9)


def test_matrices_of_transfer_functions_and_state_space_are_the_same_law():
    numerators = [[[STIFF * 100 if i == j else 3.0 * (i + 1)] for j in range(3)] for i in range(3)]
    denominators = [[[1.0, 0.0] if i == j else [1.0, 50.0 + j] for j in range(3)] for i in range(3)]
    whole = control.tf(numerators, denominators)
    law = discrete_law(whole, PERIOD)
    z = np.exp(1j * np.array([0.03, 0.5, 2.0]))
    s = 2 / PERIOD * (z - 1) / (z + 1)
    expected = np.moveaxis(whole(s), -1, 0)
    assert response(law.a, law.b, law.c, law.d, z) == pytest.approx(expected, rel=1e-9)
    sampled = control.ss(law.a, law.b, law.c, law.d, PERIOD)
    again, found = user_law(sampled, plant())
    assert found.stable
    assert np.array_equal(again.a, law.a)
    assert np.array_equal(discrete_law(control.ss(law.a, law.b, law.c, law.d, True), PERIOD).d, law.d)


@settings(max_examples=8)
@given(st.floats(1.0, 4000.0))
def test_what_is_accepted_is_stable_and_what_is_refused_is_not_or_just_so(gain):
    law = discrete_law(integrator(STIFF * gain), PERIOD)
    stable = spectral_radius(plant(), law) < 1.0
    if stable and min(axis.delay_margin_s for axis in margins(plant(), law).axes) >= 50e-6:
        assert user_law(integrator(STIFF * gain), plant())[0].d == pytest.approx(law.d, rel=1e-9)
    else:
        with pytest.raises(UnstableLawError, match="us of additional delay" if stable else "the loop is unstable"):
            user_law(integrator(STIFF * gain), plant())


@pytest.mark.parametrize(
    ("gain", "reason"),
    [(-100.0, "with its sign turned round it is stable"), (2000.0, "with a tenth of its gain it is stable")],
)
def test_a_refusal_says_what_would_help(gain, reason):
    with pytest.raises(UnstableLawError, match=reason):
        user_law(integrator(STIFF * gain), plant())


def test_too_little_delay_margin_is_refused():
    with pytest.raises(UnstableLawError, match=r"axis [xyz] bears .* us of additional delay, and 1000000.0 us"):
        user_law(integrator(STIFF * 100), plant(), delay_margin_s=1.0)


@pytest.mark.parametrize(
    ("system", "reason"),
    [
        (control.tf([1.0, 0.0], [1.0]), "more zeros than poles"),
        (control.ss([[0.5]], [[1.0]], [[1.0]], 0.0, 500e-6), "period of 500 us and the bus 200 us"),
        (control.ss(np.eye(2), np.eye(2), np.eye(2), 0.0), "3 inputs and 3 outputs"),
        (3.0, "python-control"),
    ],
)
def test_what_is_no_law_is_refused(system, reason):
    with pytest.raises(LawError, match=reason):
        user_law(system, plant())
