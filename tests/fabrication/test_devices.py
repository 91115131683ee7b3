"""Devices as they were made: without deviations the stage itself; with them what calculations of their own give."""

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from process_rig import STAGE, devices, process
from scipy.differentiate import hessian, jacobian

from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.elements.combs import EPSILON_0_F_PER_M, pull_in_stroke_m
from pkxyz_ctrl.elements.flexures import folded_spring_lateral_stiffness
from pkxyz_ctrl.fabrication import figures as figure
from pkxyz_ctrl.fabrication.devices import as_drawn, side_left
from pkxyz_ctrl.fabrication.process import SiliconConfig
from pkxyz_ctrl.fabrication.silicon import modulus_by_drawing
from pkxyz_ctrl.fabrication.statics import pose, pose_of_strokes
from pkxyz_ctrl.mechanics.modes import modes
from pkxyz_ctrl.mechanics.stiffness import (
    lifting_stiffness_n_per_m,
    nominal_stiffness_n_per_m,
    small_signal_stiffness_n_per_m,
)
from pkxyz_ctrl.mechanics.workspace import voltage_needed_v
from pkxyz_ctrl.stage import Stage

TOP = np.full(3, 25e-6)


def drawing(name="reconstructed", chains=1):
    stage = load("stages", name, StageConfig)
    return stage.model_copy(update={"flexures": stage.flexures.model_copy(update={"out_of_plane_chains": chains})})


@pytest.mark.parametrize("name", ["reconstructed", "printed"])
@pytest.mark.parametrize("chains", [1, 3])
def test_without_deviations_a_device_is_the_stage(name, chains):
    config = drawing(name, chains)
    stage, device = Stage(config), as_drawn(config, process())
    rest = pose(device, np.zeros(3))
    assert rest.stiffness_n_per_m[0] == pytest.approx(nominal_stiffness_n_per_m(config), rel=1e-9, abs=1e-9)
    low, high, vertical = figure.frequencies_hz(rest.stiffness_n_per_m, device.mass_kg)
    found = modes(nominal_stiffness_n_per_m(config), config.dynamics.mass_kg).frequency_hz
    assert sorted([low[0], high[0], vertical[0]]) == pytest.approx(sorted(found), rel=1e-9)
    assert device.comb_n_per_v2[0] == pytest.approx(stage.force_gain_n_per_v2, rel=1e-12)
    assert device.quality_factor[0] == pytest.approx(config.dynamics.quality_factor, rel=1e-12)
    assert figure.needed_voltage_v(device, TOP)[0] == pytest.approx(float(voltage_needed_v(stage, TOP)), rel=1e-9)
    f, geometry = config.flexures, stage.geometry[0]
    lifting = lifting_stiffness_n_per_m(
        device.slider_n_per_m[0, 0] / 4, device.link_n_m_per_rad[0] / 4 / chains, float(geometry["link_m"]),
        float(geometry["elevation_rest_rad"]), chains,
    )  # fmt: skip
    comb = config.drive_comb
    balance = pull_in_stroke_m(comb.finger_gap_m, 4 * folded_spring_lateral_stiffness(f), lifting, comb.overlap_rest_m)
    assert figure.pull_in_stroke_m(device)[0] == pytest.approx([balance] * 3, rel=1e-9)


def test_chains_that_differ_are_those_of_a_calibrated_stage():
    device = devices(
        youngs_modulus=[0.02, -0.03, 0.01], etch_bias_m=[0.1e-6, -0.05e-6, 0.02e-6], handle_m=3e-6,
        sidewall_rad=[1e-3, 0.0, -2e-3], hinge_m=0.3e-6,
    )  # fmt: skip
    drawn = as_drawn(STAGE, process())
    g = STAGE.geometry
    measured = Calibration(
        slider_stiffness=tuple((device.slider_n_per_m / drawn.slider_n_per_m)[0]),
        crank_stiffness=tuple((device.crank_n_m_per_rad / drawn.crank_n_m_per_rad)[0]),
        link_stiffness=float((device.link_n_m_per_rad / drawn.link_n_m_per_rad)[0]),
        comb_gain=tuple(device.comb_gain[0]),
    )
    higher = g.model_copy(update={"link_height_rest_m": g.height_rest_m + 3.3e-6})
    stage = Stage(STAGE.model_copy(update={"geometry": higher, "calibration": measured}))
    for strokes in np.random.default_rng(1).uniform(0, 25e-6, (20, 3)):
        there, position = pose_of_strokes(device, strokes)
        assert position[0] == pytest.approx(stage.forward_kinematics(strokes), rel=1e-9, abs=1e-15)
        assert there.energy_j[0] == pytest.approx(float(stage.potential_energy(position[0])), rel=1e-9)
        assert there.jacobian[0] == pytest.approx(stage.jacobian(position[0]), rel=1e-9, abs=1e-12)
        assert there.stiffness_n_per_m[0] == pytest.approx(stage.stiffness(position[0]), rel=1e-9, abs=1e-7)
        assert there.holding_n[0] == pytest.approx(stage.holding_forces(position[0]), rel=1e-9, abs=1e-15)
        held = small_signal_stiffness_n_per_m(stage, position[0], stage.holding_forces(position[0]))
        assert there.held_stiffness_n_per_m[0] == pytest.approx(held, rel=1e-9, abs=1e-7)
    assert figure.needed_voltage_v(device, TOP)[0] == pytest.approx(float(voltage_needed_v(stage, TOP)), rel=1e-9)


def energy_of(device, row):
    """Strain energy in nJ by position in units of 100 um, (3, ...), from the loop's points; links may differ."""
    l1, z0 = device.crank_m * 1e4, device.height_m[row] * 1e4

    def energy(x):
        total = 0.0
        for i, degrees in enumerate((90.0, 210.0, 330.0)):
            c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
            delta0 = device.projection_m[row, i] * 1e4
            along, across, z = c * x[0] + s * x[1], -s * x[0] + c * x[1], z0 + x[2]
            delta = np.sqrt(delta0**2 + z0**2 - z**2)
            q = along - delta - np.sqrt(l1**2 - across**2) + delta0 + l1
            theta, alpha = np.arctan2(across, np.sqrt(l1**2 - across**2)), np.arctan2(z, delta) - np.arctan2(z0, delta0)
            total = total + 0.5 * device.slider_n_per_m[row, i] * 10.0 * q**2
            total = total + 0.5e9 * device.crank_n_m_per_rad[row, i] * theta**2
            total = total + 0.5e9 * device.link_n_m_per_rad[row] / 3.0 * alpha**2
        return total

    return energy


def made_unlike(n):
    rng = np.random.default_rng(n)
    return devices(
        layer_1_m=rng.normal(0, 1e-6, (n, 1)), etch_bias_m=rng.normal(0, 0.2e-6, (n, 3)),
        handle_m=rng.normal(0, 5e-6, (n, 1)), sidewall_rad=rng.normal(0, 2e-3, (n, 3)),
        hinge_m=rng.normal(0, 0.5e-6, (n, 3)), comb_gap_m=rng.normal(0, 0.1e-6, (n, 3)),
        alignment_x_m=rng.normal(0, 2e-6, (n, 1)), alignment_y_m=rng.normal(0, 2e-6, (n, 1)),
        youngs_modulus=rng.normal(0, 0.02, (n, 3)), residual_stress_pa=rng.normal(0, 5e6, (n, 1)), of=process("100"),
    )  # fmt: skip


def test_stiffness_and_resonances_are_those_of_the_energy():
    device = made_unlike(5)
    stiffness = pose(device, np.zeros(3)).stiffness_n_per_m
    low, high, vertical = figure.frequencies_hz(stiffness, device.mass_kg)
    for row in range(5):
        found = hessian(energy_of(device, row), np.zeros(3), initial_step=0.3, order=10)
        assert found.ddf * 0.1 == pytest.approx(stiffness[row], rel=1e-9, abs=1e-7)
        hz = np.sqrt(np.linalg.eigvalsh(found.ddf * 0.1) / device.mass_kg[row]) / 2 / np.pi
        assert sorted([low[row], high[row], vertical[row]]) == pytest.approx(list(hz), rel=1e-9)


def test_what_a_point_takes_is_what_balances_the_energy():
    device = made_unlike(4)
    strokes = np.array([5e-6, 25e-6, 17e-6])
    there, position = pose_of_strokes(device, strokes)
    assert there.stroke_m == pytest.approx(np.tile(strokes, (4, 1)), rel=1e-9)
    for row in range(4):
        slope = jacobian(energy_of(device, row), position[row] * 1e4, initial_step=0.3, order=10).df * 1e-5
        assert there.gradient_n[row] == pytest.approx(slope, rel=1e-9)
        assert there.jacobian[row].T @ there.holding_n[row] == pytest.approx(slope, rel=1e-9)


@pytest.mark.parametrize("lean", [-1e-3, 0.0, 1e-9, 4e-3])
def test_springs_and_combs_of_leaning_walls_are_integrals_over_the_layer(lean):
    device = devices(sidewall_rad=lean, etch_bias_m=0.2e-6, comb_gap_m=0.1e-6)
    f, comb = STAGE.flexures, STAGE.drive_comb

    def over(height, value):
        return scipy.integrate.quad(value, 0.0, height, epsrel=1e-13)[0]

    cubed = over(f.leaf_height_m, lambda s: (f.leaf_thickness_m - 0.2e-6 - 2 * lean * s) ** 3)
    spring = 16 * f.youngs_modulus_pa * cubed / (f.leaf_inner_length_m**3 + f.leaf_outer_length_m**3)
    assert device.slider_n_per_m[0] == pytest.approx([spring] * 3, rel=1e-9)

    def gap(s):
        return comb.finger_gap_m + 0.3e-6 + 2 * lean * s

    gain = comb.finger_count * EPSILON_0_F_PER_M * over(comb.finger_height_m, lambda s: 1 / gap(s))
    assert device.comb_n_per_v2[0] == pytest.approx([gain] * 3, rel=1e-9)
    # side stiffness of straight fingers in their middle, by V^2 and overlap: 2 n eps0 sum of dh / g^3
    side = 2 * comb.finger_count * EPSILON_0_F_PER_M * over(comb.finger_height_m, lambda s: 1 / gap(s) ** 3)
    assert 2 * gain / device.side_gap_m[0, 0] ** 2 == pytest.approx(side, rel=1e-9)


@pytest.mark.parametrize("offset", [0.0, 1e-4, 0.02, 0.1, 0.5])
def test_fingers_that_stand_aside_snap_where_no_balance_is_left(offset):
    """The largest pull P at which P (1 / (1 - D)^2 - 1 / (1 + D)^2) = 4 (D - d) has a solution; 1 at d = 0."""

    def pull(at):
        return -(at - offset) * 4 / (1 / (1 - at) ** 2 - 1 / (1 + at) ** 2)

    if offset == 0.0:
        assert side_left(np.array([0.0])) == pytest.approx([1.0], rel=1e-12)
        return
    best = scipy.optimize.minimize_scalar(pull, bounds=(offset, 1 - 1e-9), method="bounded", options={"xatol": 1e-12})
    assert side_left(np.array([offset])) == pytest.approx([-best.fun], rel=1e-9)


OFFSETS = [0.0, 1e-9, 0.05e-6, 0.3e-6, -0.3e-6, 2e-6]


def unlike_chains(offset):
    """A device whose chains have springs, gaps and fingers of their own, and the gaps."""
    bias, wider = np.array([0.2e-6, -0.1e-6, 0.05e-6]), np.array([0.1e-6, 0.0, -0.2e-6])
    device = devices(
        etch_bias_m=bias, comb_gap_m=wider, youngs_modulus=[-0.08, 0.06, 0.0], hinge_m=0.4e-6, handle_m=2e-6,
        layer_1_m=0.7e-6, finger_offset_m=[offset, 0.1e-6, 0.5 * offset],
    )  # fmt: skip
    return device, STAGE.drive_comb.finger_gap_m + bias + wider


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("stroke", [0.0, 25e-6])
def test_a_comb_snaps_at_the_voltage_at_which_its_fingers_have_no_balance_left(offset, stroke):
    """Spring and field of one comb, its stroke held: the energy k (D - d)^2 / 2 - C V^2 / 2, C of all gaps in parallel,
    has a minimum beside d as long as V^2 is below the largest k (D - d) / (dC/dD / 2).
    """
    device, gaps = unlike_chains(offset)
    comb, f = STAGE.drive_comb, STAGE.flexures
    height = comb.finger_height_m * (1 + 0.7e-6 / f.leaf_height_m)
    for chain, gap in enumerate(gaps):
        aside = abs([offset, 0.1e-6, 0.5 * offset][chain]) * 1e6
        # a leaf straight, 2 E h w / L, in series with one that is bent, 200 E h w^3 / (36 L q^2 / 3)
        bent = 1.0 + 36.0 * stroke**2 / (100.0 * device.leaf_m[0, chain] ** 2)
        lateral = device.lateral_n_per_m[0, chain] / bent
        of = comb.finger_count * EPSILON_0_F_PER_M * height * (comb.overlap_rest_m + stroke)

        def squared_v2(d_um, aside=aside, gap=gap, lateral=lateral, of=of):
            d = d_um * 1e-6
            return lateral * (d - aside * 1e-6) / (0.5 * of * (1 / (gap - d) ** 2 - 1 / (gap + d) ** 2))

        if aside == 0.0:
            most = lateral / (0.5 * of * 4 / gap**3)
        else:
            best = scipy.optimize.minimize_scalar(
                lambda d: -squared_v2(d), bounds=(aside, 0.999e6 * gap), method="bounded", options={"xatol": 1e-11}
            )
            most = -best.fun
        assert figure.snap_voltage_v(device, stroke)[0, chain] == pytest.approx(np.sqrt(most), rel=1e-9)


def lifting_of_energy(device):
    """Force of each comb over the stroke that all three have (3,), in N/m, at rest: of the energy alone."""

    def strokes(x):
        return np.stack([
            c * x[0] + s * x[1] - np.sqrt(d**2 + z0**2 - (z0 + x[2]) ** 2) - np.sqrt(l1**2 - (c * x[1] - s * x[0]) ** 2)
            for c, s, d in zip(np.cos(ways), np.sin(ways), device.projection_m[0] * 1e4, strict=True)
        ])  # fmt: skip

    ways, l1, z0 = np.radians([90.0, 210.0, 330.0]), device.crank_m * 1e4, device.height_m[0] * 1e4
    stiffness = hessian(energy_of(device, 0), np.zeros(3), initial_step=0.3, order=10).ddf * 0.1
    moves = jacobian(strokes, np.zeros(3), initial_step=0.3, order=10).df
    return np.linalg.solve(moves.T, stiffness @ np.linalg.solve(moves, np.ones(3)))


@pytest.mark.parametrize("offset", OFFSETS)
def test_pull_in_of_unlike_chains_is_where_the_energy_loses_its_minimum(offset):
    """Stroke q and fingers' way aside D of one comb at a voltage: a q^2 / 2 + k (D - d)^2 / 2 - P (y_0 + q) c(D), with
    c = 1 / (g - D) + 1 / (g + D) and P that goes with V^2. At the largest P of the balances it is flat in a direction.
    """
    device, gaps = unlike_chains(offset)
    axial, y0 = lifting_of_energy(device), STAGE.drive_comb.overlap_rest_m * 1e6
    assert figure.lifting_n_per_m(device)[0] == pytest.approx(axial, rel=1e-9)
    assert np.ptp(axial) > 0.01 * axial[0]
    for chain, (g, a) in enumerate(zip(gaps * 1e6, axial, strict=True)):
        d, k = abs([offset, 0.1e-6, 0.5 * offset][chain]) * 1e6, device.lateral_n_per_m[0, chain]

        def derivatives(x, g=g, a=a, k=k, d=d):
            """Of the energy: by q, by D, and the determinant of the second ones, each over its own size."""
            q, aside, p = x
            near, far = 1 / (g - aside), 1 / (g + aside)
            c, slope, bend = near + far, near**2 - far**2, 2 * (near**3 + far**3)
            flat = a * (k - p * (y0 + q) * bend) - (p * slope) ** 2
            return [1 - p * c / (a * q), 1 - p * (y0 + q) * slope / (k * (aside - d)), flat / (a * k)]

        if d == 0.0:  # straight until P (y_0 + q) c'' = k, where P c = a q
            found = max(np.roots([2 * a / g**2, 2 * a * y0 / g**2, -k]))
        else:
            begin = largest_balance(g, a, k, d, y0)
            found = scipy.optimize.root(derivatives, begin, method="hybr", options={"xtol": 1e-14}).x[0]
            assert found == pytest.approx(begin[0], rel=1e-2)
        assert figure.pull_in_stroke_m(device)[0, chain] * 1e6 == pytest.approx(found, rel=1e-9)


def largest_balance(g, a, k, d, y0):
    """q, D and P of the balance with the largest P, of many."""
    aside = d + (g - d) * np.linspace(0.0, 0.9, 200_001)[1:]
    near, far = 1 / (g - aside), 1 / (g + aside)
    turned = k * (aside - d) * (near + far) / (a * (near**2 - far**2))  # q (y_0 + q)
    q = np.sqrt(0.25 * y0**2 + turned) - 0.5 * y0
    p = a * q / (near + far)
    return [v[np.argmax(p)] for v in (q, aside, p)]


def test_a_tenth_of_a_um_makes_four_per_cent_of_stiffness():
    softer = devices(etch_bias_m=0.1e-6).slider_n_per_m / devices().slider_n_per_m
    assert softer == pytest.approx(np.full((1, 3), (7.9 / 8.0) ** 3), rel=1e-12)


def test_what_is_not_held_whole_is_held_up_to_a_stroke():
    device = devices(hinge_m=[[0.0], [1.0e-6], [2.0e-6]])
    top_v = figure.corner_voltage_v(device, 0.0, 25e-6)
    held = figure.held_stroke_m(device, top_v, 0.0, 25e-6, 200.0)
    assert held[0] == 25e-6
    assert top_v[0] < 200 < top_v[1] < top_v[2]
    assert held[2] < held[1] < 25e-6
    assert figure.corner_voltage_v(device, 0.0, held)[1:] == pytest.approx([200.0, 200.0], rel=1e-9)
    inside = np.random.default_rng(1).uniform(0, 1, (100, 3)) * held[2]
    assert max(figure.needed_voltage_v(device.take(np.array([2])), q)[0] for q in inside) <= 200.0


def test_silicon_is_stiffer_along_the_diagonal_and_alike_in_the_111_plane():
    along, across = modulus_by_drawing(SiliconConfig(plane="100"), 1e9)
    # chain 1 along y, a <110>: 169 GPa; the others 30 degrees off, 15 from a <100>
    assert along == pytest.approx([168.9, 138.1, 138.1], rel=2e-3)
    assert across == pytest.approx(along, rel=1e-12)  # fourfold: a right angle changes nothing
    turned, _ = modulus_by_drawing(SiliconConfig(plane="100", flat_rad=np.pi / 4), 1e9)
    assert turned[0] == pytest.approx(130.1, rel=2e-3)
    flat = np.concatenate(modulus_by_drawing(SiliconConfig(plane="111"), 1e9))
    assert flat == pytest.approx(np.full(6, 169.1), rel=2e-3)
    assert np.ptp(flat) < 1e-9


def test_a_mechanism_of_three_on_a_crystal_of_four_has_two_resonances_in_the_plane():
    for plane, least, most in (("100", 20.0, 26.0), ("111", 0.0, 1e-6)):
        device = devices(of=process(plane))
        low, high, _ = figure.frequencies_hz(pose(device, np.zeros(3)).stiffness_n_per_m, device.mass_kg)
        assert least <= high[0] - low[0] <= most


@pytest.mark.filterwarnings("error")
def test_a_process_that_leaves_nothing_says_so():
    with pytest.raises(ValueError, match="leaves no leaf width"):
        devices(etch_bias_m=9e-6)
    with pytest.raises(ValueError, match="leaves no comb gap"):
        devices(comb_gap_m=-6e-6)
    narrow = STAGE.model_copy(update={"sense_comb": STAGE.sense_comb.model_copy(update={"finger_gap_m": 3e-6})})
    with pytest.raises(ValueError, match="leaves no sense gap downwards"):
        devices(narrow, sidewall_rad=-0.02)
