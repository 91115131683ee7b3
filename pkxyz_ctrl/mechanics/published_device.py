"""What the paper prints about the whole device: dimensions, workspace, modes and its appendices."""

import math

from pkxyz_ctrl.mechanics import readings as read
from pkxyz_ctrl.mechanics.inscribed import inscribed_cube
from pkxyz_ctrl.mechanics.modes import effective_mass_kg, sag_m
from pkxyz_ctrl.mechanics.reproduction import Entry
from pkxyz_ctrl.mechanics.stiffness import nominal_stiffness_n_per_m
from pkxyz_ctrl.mechanics.workspace import workspace
from pkxyz_ctrl.stage import Stage


def dimensions() -> list[Entry]:
    return [
        Entry(
            "IV.E",
            "r = R_b - R",
            "mm",
            "2",
            lambda s: s.config.geometry.base_radius_m * 1e3,
            "2.5 - 0.5; an input of both designs",
        ),
        Entry(
            "IV.E",
            "stroke of a comb",
            "um",
            "25",
            lambda s: s.config.limits.stroke_max_m * 1e6,
            "an input of both designs",
        ),
        Entry("IV.E", "L1", "mm", "0.5", lambda s: s.config.geometry.crank_length_m * 1e3, "an input of both designs"),
        Entry("IV.E", "L2", "mm", "0.589", lambda s: read.link_m(s) * 1e3, "reconstructed: sqrt(500^2 + 311^2) um"),
        Entry("IV.E", "alpha_0", "rad", "0.6", read.elevation_rad, "reconstructed: 0.5564, which is 0.6 to one digit"),
        Entry(
            "IV.E",
            "z_0 by the layers: 300 + 2 x 0.5 + t_3",
            "um",
            lambda s: 300 + 2 * 0.5 + s.config.flexures.link_hinge_thickness_m * 1e6,
            lambda s: float(s.geometry["height_rest_m"][0]) * 1e6,
            "hinge to hinge through the handle layer and both oxides; the paper gives the layers, not the sum",
        ),
        Entry(
            "IV",
            "cube within the workspace",
            "um",
            "20",
            lambda s: inscribed_cube(s).side_m * 1e6,
            "standing on its corner, as the workspace does; with faces along x, y, z only 12 um",
        ),
        Entry(
            "Eq. 36",
            "tan(alpha) at mid-stroke",
            "",
            "0.677",
            read.middle_slope,
            "at mid-stroke, as the text says; at rest 0.622",
        ),
        Entry(
            "IV.E",
            "volume of the workspace",
            "um^3",
            "2432.5",
            lambda s: workspace(s).linear_volume_m3 * 1e18,
            "no input gives it; it is less than the 20 um cube (8000 um^3) that the text asks for",
        ),
        Entry(
            "IV.E",
            "highest z",
            "um",
            "36",
            lambda s: s.config.limits.stroke_max_m * 1e6 / read.middle_slope(s),
            "25 um over tan(alpha) at mid-stroke, cut to two digits; exactly 36.99 um",
        ),
        Entry("IV.E", "largest tilt", "mrad", "2.61", None, "finite elements; the rigid mechanism has no tilt"),
    ]


def dynamics() -> list[Entry]:
    def ratio(s: Stage) -> float:
        return math.sqrt(read.stiffness_n_per_m(s, 2) / read.stiffness_n_per_m(s, 0))

    def mass_mg(s: Stage) -> float:
        return effective_mass_kg(read.stiffness_n_per_m(s, 0), read.FREQUENCY_XY_HZ) * 1e6

    grams_kg = read.MASS_PRINTED_MG * 1e-3
    return [
        Entry("IV.F", "K_xx", "N/mm", "0.0759", lambda s: read.stiffness_n_per_m(s, 0) * 1e-3, "Eq. 19; 0.07596, cut"),
        Entry(
            "IV.F",
            "K_zz",
            "N/mm",
            "0.1136",
            lambda s: read.stiffness_n_per_m(s, 2) * 1e-3,
            "Eq. 19 with 4 K_3, as printed",
        ),
        Entry(
            "Eq. 16, 26",
            "K_xx with the four leaves of a spring counted once",
            "N/mm",
            "0.0759",
            read.stiffness_leaves_once_n_per_mm,
            "Eq. 26 puts the leaves together and Eq. 16 takes four more: the published K_xx counts both, and so do we",
        ),
        Entry(
            "Eq. 19",
            "K_zz with pivots on all three chains",
            "N/mm",
            "0.1136",
            lambda s: read.stiffness_n_per_m(s, 2, 3) * 1e-3,
            "the text has four pivots on each of three chains, 12 K_3; the published number counts one chain",
            lambda s: (0.1136, read.stiffness_n_per_m(s, 2, 1) * 1e-3),
        ),
        Entry(
            "Eq. 40",
            "moving mass",
            "mg",
            "3.655e-3",
            mass_mg,
            "the unit must be g; even so the frequencies ask for 4.834 mg, 32 % more",
            lambda s: (read.MASS_PRINTED_MG * 1e3, mass_mg(s)),
        ),
        Entry(
            "Eq. 40",
            "f_x = f_y",
            "Hz",
            "630.92",
            lambda s: read.frequency_hz(s, 0, grams_kg),
            "725.5 Hz with 3.655 mg; 4.833 mg was fitted to this number, so that its 631.0 Hz prove nothing",
            lambda s: (read.FREQUENCY_XY_HZ, read.frequency_hz(s, 0, s.config.dynamics.mass_kg)),
        ),
        Entry(
            "Eq. 40",
            "f_z",
            "Hz",
            "771.75",
            lambda s: read.frequency_hz(s, 2, grams_kg),
            "887.5 Hz with 3.655 mg; 771.8 Hz with the mass that was fitted to f_x",
            lambda s: (read.FREQUENCY_Z_HZ, read.frequency_hz(s, 2, s.config.dynamics.mass_kg)),
        ),
        Entry("Eq. 40", "f_z / f_xy", "", "1.22321", ratio, "free of the mass: only the reconstructed design has it"),
        Entry(
            "IV.F",
            "mode 1: stroke of the third comb",
            "",
            "0",
            lambda s: float(read.mode_strokes(s, 0)[0]),
            "x: two in anti-phase, one at rest",
        ),
        Entry(
            "IV.F",
            "mode 2: amplitude of the third comb",
            "",
            "2",
            lambda s: float(-read.mode_strokes(s, 1)[0] / read.mode_strokes(s, 1)[1]),
            "y: in anti-phase with twice the amplitude",
        ),
        Entry(
            "IV.F",
            "mode 3: amplitudes alike",
            "",
            "1",
            lambda s: float(read.mode_strokes(s, 2)[0] / read.mode_strokes(s, 2)[1]),
            "z: all in phase",
        ),
        Entry(
            "IV.F",
            "sag under gravity",
            "nm",
            "52",
            lambda s: -float(sag_m(nominal_stiffness_n_per_m(s.config, 1), grams_kg)[2]) * 1e9,
            "finite elements; all of the mass hung on K_zz gives six times that",
        ),
        Entry(
            "IV.F",
            "stiffness of the lowest parasitic mode",
            "times",
            "17",
            None,
            "finite elements; the rigid mechanism has no rotation",
        ),
    ]


def _coefficient(power: int) -> Entry:
    printed, ours = read.APPENDIX_COEFFICIENTS[power], read.appendix_coefficient(power)
    label = {0: 6, 1: 5}.get(power, power)
    why = f"printed as c_{label}, to four digits"
    if power == 0:
        why += "; its overall factor of -2 is lost"
    return Entry(
        "App. A",
        f"c_{power} at lambda = 0",
        f"mm^{6 - power}",
        lambda s: printed,
        lambda s: ours,
        why,
        (lambda s: (-2 * printed, ours)) if power == 0 else None,
    )


def _slope(power: int) -> Entry:
    printed, ours = read.APPENDIX_SLOPES[power], read.appendix_slope(power)
    why = "the term in lambda_1 alone, to four digits; those of lambda_2 and lambda_3 are alike"
    if power == 3:
        why += "; a stray delta^3 stands before the bracket"
    return Entry("App. A", f"c_{power}, term in lambda_1", f"mm^{5 - power}", lambda s: printed, lambda s: ours, why)


def appendices() -> list[Entry]:
    rows = [_coefficient(power) for power in range(6, -1, -1)] + [_slope(power) for power in range(5, 0, -1)]
    return [
        *rows,
        Entry(
            "App. A",
            "r",
            "mm",
            "2.5",
            lambda s: -read.APPENDIX_COEFFICIENTS[5] / 432 / 6,
            "the coefficients are those of r = 2 + 1/sqrt(2) = 2.7071",
            lambda s: (read.APPENDIX_RADIUS_MM, -read.APPENDIX_COEFFICIENTS[5] / 432 / 6),
        ),
        Entry(
            "App. A",
            "delta at lambda = 0 from the printed coefficients",
            "um",
            lambda s: read.delta_printed_um(),
            lambda s: (read.APPENDIX_RADIUS_MM - 1.0) * 1e3,
            "four digits, c_0 repaired; true is r - L1; good for a look, not for use",
        ),
        Entry(
            "App. B",
            "largest tilt on the path",
            "mrad",
            "2.6",
            None,
            "finite elements; the path is drawn, the rigid model has no tilt",
        ),
    ]
