"""Dimensions from requirements: the procedure of the paper's section IV.E.

The wafer fixes the height of the out-of-plane link. Its hinges are ``link_hinge_thickness_m`` thick and lie
against the handle layer's two oxides, so from mid-plane to mid-plane z_0 = handle + 2 oxide + t_3: 300 + 1 + 10 =
311 um, the height of the reconstructed design. What is left to choose is the crank L1 and the link's projection
delta_0 (or L2 and alpha_0).

Each requirement is a margin, positive where it is met: room / need - 1. The recommendation is the analytic centre
of the feasible region, where the product of the margins (each counted up to 1) is largest. Margins are exact, from
the Stage's energy and kinematics; on the map of the region alone the cube's uses the Jacobian at mid-stroke, which
may be 2 % too large.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pkxyz_ctrl.config.files import plain
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.elements.combs import force_gain_n_per_v2
from pkxyz_ctrl.elements.errors import InfeasibleDesignError, require_positive
from pkxyz_ctrl.elements.flexures import crank_hinge_range_rad, link_hinge_range_rad
from pkxyz_ctrl.mechanics.inscribed import inscribed_cube, standing_cube_m
from pkxyz_ctrl.mechanics.jacobians import joint_angles
from pkxyz_ctrl.mechanics.modes import modes
from pkxyz_ctrl.mechanics.stiffness import nominal_stiffness_n_per_m
from pkxyz_ctrl.mechanics.workspace import box_corners
from pkxyz_ctrl.stage import Stage, StageDomainError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Requirements:
    """What the device shall do and what it is made from.

    The defaults are the paper's, but for the voltage: at its 130 V no dimensions reach the whole 25 um, so it is
    the 200 V of the shipped stages' amplifier.
    """

    stroke_m: float = 25e-6
    cube_side_m: float = 20e-6
    frequency_min_hz: float = 500.0
    frequency_max_hz: float = 1000.0
    voltage_max_v: float = 200.0
    device_layer_1_m: float = 90e-6
    device_layer_2_m: float = 27e-6
    handle_layer_m: float = 300e-6
    oxide_m: float = 0.5e-6
    base_radius_m: float = 2e-3
    mass_kg: float = 4.833e-6
    out_of_plane_chains: int = 1

    def __post_init__(self) -> None:
        require_positive(**{name: float(value) for name, value in vars(self).items()})
        if not self.frequency_min_hz < self.frequency_max_hz:
            raise InfeasibleDesignError(
                f"frequency_min_hz < frequency_max_hz is violated: "
                f"{self.frequency_min_hz:g} and {self.frequency_max_hz:g}"
            )

    def link_height_m(self, hinge_thickness_m: float) -> float:
        """z_0: from the middle of one hinge to the middle of the other, through the handle layer and both oxides."""
        return self.handle_layer_m + 2 * self.oxide_m + hinge_thickness_m


MARGINS = (
    "closure",
    "lowest frequency",
    "highest frequency",
    "comb force",
    "cube",
    "crank hinge",
    "link hinge",
    "layer 2",
)
"""Names of the margins, in the order of their arrays."""

_CUBE = MARGINS.index("cube")


@dataclass(frozen=True)
class Region:
    """Margins over a grid of cranks L1 (n,) and link elevations alpha_0 (m,): (n, m, len(MARGINS)); NaN-free."""

    crank_m: Array
    elevation_rad: Array
    margin: Array

    def feasible(self) -> NDArray[np.bool_]:
        """(n, m): where every margin is positive."""
        return np.asarray((self.margin > 0).all(axis=-1))


@dataclass(frozen=True)
class Selection:
    """A recommended device and where it lies among the feasible ones."""

    config: StageConfig
    margin: Array
    """(len(MARGINS),) at the recommendation"""
    cube_side_m: float
    """exact, standing on its corner"""
    region: Region


def candidate(need: Requirements, template: StageConfig, crank_m: float, projection_m: float, name: str) -> StageConfig:
    """The stage of ``template``'s flexures and combs in the wafer of ``need``, with the crank and link given."""
    data = plain(template)
    data.pop("calibration", None)  # of another device
    data["name"] = name
    data["geometry"] = {
        "base_radius_m": need.base_radius_m,
        "crank_length_m": crank_m,
        "link_projection_rest_m": projection_m,
        "link_height_rest_m": need.link_height_m(template.flexures.link_hinge_thickness_m),
    }
    layer = need.device_layer_1_m
    data["flexures"] |= {
        "leaf_height_m": layer,
        "crank_hinge_height_m": layer,
        "out_of_plane_chains": need.out_of_plane_chains,
    }
    data["drive_comb"] |= {"finger_height_m": layer}
    data["sense_comb"] |= {"finger_height_m": layer}
    data["dynamics"] |= {"mass_kg": need.mass_kg}
    data["limits"] = {"stroke_min_m": 0.0, "stroke_max_m": need.stroke_m, "voltage_max_v": need.voltage_max_v}
    return StageConfig.model_validate(data)


def margins(need: Requirements, template: StageConfig, crank_m: float, projection_m: float) -> Array:
    """The margins (len(MARGINS),) of one choice, -1 for all that cannot be told because the links do not close."""
    out = np.full(len(MARGINS), -1.0)
    out[7] = need.device_layer_2_m / template.flexures.link_hinge_thickness_m - 1
    out[0] = (need.base_radius_m - projection_m - crank_m) / need.stroke_m - 1
    if out[0] <= -1:
        out[0] = max(out[0], -1e3)
        return out
    stage = Stage(candidate(need, template, crank_m, projection_m, "candidate"))
    try:
        corners = stage.forward_kinematics(box_corners(0.0, need.stroke_m))
        middle = stage.forward_kinematics(np.full(3, need.stroke_m / 2))
    except StageDomainError:
        return out
    frequency = modes(nominal_stiffness_n_per_m(stage.config), need.mass_kg).frequency_hz
    crank, link = joint_angles(stage, corners)
    rest = float(stage.geometry["elevation_rest_rad"][0])
    out[1] = frequency[0] / need.frequency_min_hz - 1
    out[2] = need.frequency_max_hz / frequency[2] - 1
    out[3] = float((stage.force_max_n / stage.holding_forces(corners).max(axis=0)).min()) - 1
    out[4] = linear_standing_cube_m(float(stage.jacobian(middle)[0, 2]), need.stroke_m) / need.cube_side_m - 1
    out[5] = crank_hinge_range_rad(stage.config.flexures) / float(np.abs(crank).max()) - 1
    out[6] = link_hinge_range_rad(stage.config.flexures) / float(np.abs(link - rest).max()) - 1
    return out


def linear_standing_cube_m(slope: float, stroke_m: float) -> float:
    """Side in m of the largest cube standing on its corner in the linear workspace,
    ``slope`` = tan(alpha) at mid-stroke.

    With edges sqrt(2/3) e_j + sqrt(1/3) z, side sum_j |[e_i, slope] . edge_j| = stroke. Largest, stroke /
    sqrt(1.5), at slope 1/sqrt(2), where the workspace itself is a cube.
    """
    along, across = math.sqrt(2 / 3) + slope / math.sqrt(3), -math.sqrt(1 / 6) + slope / math.sqrt(3)
    return stroke_m / (abs(along) + 2 * abs(across))


def select(need: Requirements, template: StageConfig, name: str = "designed", grid: int = 49) -> Selection:
    """The recommended device for the requirements, with flexures and combs taken from ``template``.

    Raises ``InfeasibleDesignError`` that names the binding constraint and by how much it is missed.
    """
    height = need.link_height_m(template.flexures.link_hinge_thickness_m)
    region = feasible_region(need, template, grid)
    at = np.unravel_index(int(region.margin.min(axis=-1).argmax()), region.margin.shape[:2])

    def choice(v: Array) -> tuple[float, float]:
        return float(v[0]) * 1e-3, height / math.tan(float(v[1]))

    def objective(v: Array) -> float:
        if not (v[0] > 0 and 0 < v[1] < math.pi / 2):
            return 1e6
        m = margins(need, template, *choice(v))
        if (m > 0).all():
            m = _with_cube(need, m, standing_cube_m(Stage(candidate(need, template, *choice(v), name))))
        # inside, the product of the margins, each counted up to 1; outside, the way back in
        return float(-np.log(np.minimum(m, 1.0)).sum()) if (m > 0).all() else 1e3 * (1 - float(m.min()))

    start = np.array([region.crank_m[at[0]] * 1e3, region.elevation_rad[at[1]]])
    found = minimize(objective, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3, "maxiter": 200})
    crank, delta = (round(length, 7) for length in choice(found.x))  # masks are drawn to 0.1 um
    margin = margins(need, template, crank, delta)
    config = candidate(need, template, crank, delta, name)
    if (margin > 0).all():
        margin = _with_cube(need, margin, inscribed_cube(Stage(config)).side_m)
    if not (margin > 0).all():
        raise InfeasibleDesignError(_binding(need, template, region))
    return Selection(config, margin, (1 + float(margin[_CUBE])) * need.cube_side_m, region)


def _with_cube(need: Requirements, margin: Array, side_m: float) -> Array:
    """``margin`` with that of the cube replaced by an exact side."""
    exact = margin.copy()
    exact[_CUBE] = side_m / need.cube_side_m - 1
    return exact


def feasible_region(need: Requirements, template: StageConfig, grid: int = 49) -> Region:
    """Margins over cranks from 0.1 to 1.4 mm and elevations from 0.2 to 1.1 rad."""
    height = need.link_height_m(template.flexures.link_hinge_thickness_m)
    cranks, elevations = np.linspace(0.1e-3, 1.4e-3, grid), np.linspace(0.2, 1.1, grid)
    table = [[margins(need, template, float(c), height / math.tan(a)) for a in elevations] for c in cranks]
    return Region(cranks, elevations, np.array(table))


def _binding(need: Requirements, template: StageConfig, region: Region) -> str:
    """One line: the single requirement that has to give way for the others to be met, where it is missed least."""
    least: tuple[float, int, tuple[int, int]] | None = None
    for k in range(len(MARGINS)):
        others = (np.delete(region.margin, k, axis=-1) > 0).all(axis=-1)
        if others.any():
            best = np.where(others, region.margin[..., k], -np.inf)
            at = np.unravel_index(int(best.argmax()), best.shape)
            if least is None or best[at] > least[0]:
                least = (float(best[at]), k, (int(at[0]), int(at[1])))
    lead = "no (L1, L2, alpha_0) fulfils the requirements: "
    if least is not None:
        k, at_ij = least[1], least[2]
        short = _shortfall(need, template, region, k, at_ij)
        return f"{lead}{MARGINS[k]} binds: {short}; {_where(need, template, region, at_ij)}"
    worst = region.margin.min(axis=-1)
    i, j = (int(n) for n in np.unravel_index(int(worst.argmax()), worst.shape))
    missed = [k for k in range(len(MARGINS)) if region.margin[i, j, k] <= 0]
    words = "; ".join(f"{MARGINS[k]}: {_shortfall(need, template, region, k, (i, j))}" for k in missed)
    return f"{lead}{len(missed)} of them bind together: {words}; {_where(need, template, region, (i, j))}"


def _where(need: Requirements, template: StageConfig, region: Region, at: tuple[int, int]) -> str:
    link = need.link_height_m(template.flexures.link_hinge_thickness_m) / math.sin(region.elevation_rad[at[1]])
    return (
        f"closest at L1 = {region.crank_m[at[0]] * 1e6:.0f} um, L2 = {link * 1e6:.0f} um, "
        f"alpha_0 = {region.elevation_rad[at[1]]:.3f} rad"
    )


def _shortfall(need: Requirements, template: StageConfig, region: Region, k: int, at: tuple[int, int]) -> str:
    """What requirement ``k`` asks for, what is there and the difference, in its own unit."""
    room = 1 + float(region.margin[at][k])
    if MARGINS[k] == "comb force":
        comb = template.drive_comb.model_copy(update={"finger_height_m": need.device_layer_1_m})
        have = force_gain_n_per_v2(comb) * need.voltage_max_v**2
        return (
            f"the top of the workspace needs {have / room * 1e3:.4g} mN "
            f"({need.voltage_max_v / math.sqrt(room):.4g} V), "
            f"{have * 1e3:.4g} mN ({need.voltage_max_v:.4g} V) are there, {(1 / room - 1) * have * 1e3:.3g} mN short"
        )
    if MARGINS[k] == "highest frequency":
        asked, have, unit = need.frequency_max_hz, need.frequency_max_hz / room, "Hz"
        return (
            f"at most {asked:.4g} {unit} are asked for, {have:.4g} {unit} reached, {have - asked:.3g} {unit} too many"
        )
    asked, unit = {
        "closure": (need.stroke_m * 1e6, "um of travel before the centre"),
        "lowest frequency": (need.frequency_min_hz, "Hz"),
        "cube": (need.cube_side_m * 1e6, "um of cube side"),
        "crank hinge": (crank_hinge_range_rad(template.flexures) / room, "rad"),
        "link hinge": (link_hinge_range_rad(template.flexures) / room, "rad"),
        "layer 2": (template.flexures.link_hinge_thickness_m * 1e6, "um for the hinge"),
    }[MARGINS[k]]
    return f"{asked:.4g} {unit} asked for, {asked * room:.4g} there, {asked * (1 - room):.3g} short"
