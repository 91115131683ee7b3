"""What a device that was made is worth before any loop is closed: resonances, pull-in, voltages, workspace.

Each figure is an array over the devices, by name.
"""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.fabrication.devices import Devices, side_left
from pkxyz_ctrl.fabrication.statics import pose, pose_of_strokes

Array = NDArray[np.float64]

FIGURES: dict[str, str] = {
    "frequency_low_hz": "lower resonance in the plane, at rest",
    "frequency_high_hz": "upper resonance in the plane, at rest",
    "frequency_z_hz": "resonance out of the plane, at rest",
    "frequency_held_hz": "lowest resonance, held in the middle of the strokes",
    "split_hz": "between the two resonances in the plane",
    "stiffness": "largest deviation of a stiffness at rest from the drawing, relative",
    "mass": "of the moving mass from the drawing, relative",
    "comb_gain": "largest deviation of a comb's pull from the drawing, relative",
    "comb_unlike": "largest less least pull of the three combs, relative",
    "sense_gain": "largest deviation of a sense comb's gradient from the drawing, relative",
    "quality_factor": "of the resonances in the plane",
    "pull_in_m": "stroke at which a comb that lifts snaps sideways, of the worst chain",
    "snap_v": "voltage at which a comb at the end of its stroke snaps sideways, of the worst chain",
    "top_v": "voltage that holds the corner of the strokes that needs most",
    "held_m": "stroke up to which the voltage limit holds every set of strokes",
}
"""By name: what it is. Frequencies in Hz, lengths in m, voltages in V, all else a number."""

_BENT = 5.0 / 3.0
"""A folded spring's lateral stiffness has halved at 1.67 times the width of its leaves (Legtenberg, Groeneveld,
Elwenspoek: J. Micromech. Microeng. 6 (1996) 320): 2 E h w / L straight and 200 E I / (3 L q^2) bent are equal."""


def figures(stage: StageConfig, drawn: Devices, devices: Devices) -> dict[str, Array]:
    """Every figure of ``FIGURES`` (n,). ``drawn``: one device as drawn."""
    limits = stage.limits
    rest = pose(devices, np.zeros(3))
    stiffness = rest.stiffness_n_per_m
    low, high, vertical = frequencies_hz(stiffness, devices.mass_kg)
    middle, _ = pose_of_strokes(devices, np.full(3, 0.5 * (limits.stroke_min_m + limits.stroke_max_m)))
    held_hz = np.sqrt(np.linalg.eigvalsh(middle.held_stiffness_n_per_m)[:, 0] / devices.mass_kg) / (2.0 * math.pi)
    diagonal = np.diagonal(stiffness, axis1=1, axis2=2)
    as_drawn = np.diagonal(pose(drawn, np.zeros(3)).stiffness_n_per_m, axis1=1, axis2=2)
    top_v = corner_voltage_v(devices, limits.stroke_min_m, limits.stroke_max_m)
    return {
        "frequency_low_hz": low,
        "frequency_high_hz": high,
        "frequency_z_hz": vertical,
        "frequency_held_hz": held_hz,
        "split_hz": high - low,
        "stiffness": np.abs(diagonal / as_drawn - 1.0).max(axis=1),
        "mass": devices.mass_kg / drawn.mass_kg - 1.0,
        "comb_gain": np.abs(devices.comb_gain - 1.0).max(axis=1),
        "comb_unlike": np.ptp(devices.comb_gain, axis=1),
        "sense_gain": np.abs(devices.sense_gain - 1.0).max(axis=1),
        "quality_factor": devices.quality_factor,
        "pull_in_m": pull_in_stroke_m(devices).min(axis=1),
        "snap_v": snap_voltage_v(devices, limits.stroke_max_m).min(axis=1),
        "top_v": top_v,
        "held_m": held_stroke_m(devices, top_v, limits.stroke_min_m, limits.stroke_max_m, limits.voltage_max_v),
    }


def frequencies_hz(stiffness_n_per_m: Array, mass_kg: Array) -> tuple[Array, Array, Array]:
    """The two resonances in the plane, lower first, and that out of it, (n,) each."""
    values, shapes = np.linalg.eigh(stiffness_n_per_m)
    hz = np.sqrt(values / mass_kg[:, None]) / (2.0 * math.pi)
    upright = np.argmax(np.abs(shapes[:, 2, :]), axis=1)
    vertical = np.take_along_axis(hz, upright[:, None], axis=1)[:, 0]
    plane = hz[np.arange(3) != upright[:, None]].reshape(-1, 2)
    return plane[:, 0], plane[:, 1], vertical


def lifting_n_per_m(devices: Devices) -> Array:
    """What each comb works against at rest when all three lift (n, 3): Eq. 24 of devices whose chains differ."""
    rest = pose(devices, np.zeros(3))
    move = np.linalg.solve(rest.jacobian, np.ones((len(devices), 3, 1)))
    force = rest.stiffness_n_per_m @ move
    return np.asarray(np.linalg.solve(rest.jacobian.transpose(0, 2, 1), force)[..., 0])


def pull_in_stroke_m(devices: Devices) -> Array:
    """``combs.pull_in_stroke_m`` of each chain (n, 3), with fingers that stand aside and gaps that widen.

    Fingers that stand d aside move on to D as the voltage rises, and pull the more. With u = D / g and a, k of comb and
    lateral spring the balances are q (y_0 + q) = k g^2 / (2 a) (u - d / g) (1 - u^2) / u, of which the last that a
    rising voltage reaches is that with the largest V^2, which goes with q (1 - u^2).
    """
    half, offset = 0.5 * devices.overlap_m, devices.side_offset
    side = devices.side_gap_m**2 * devices.lateral_n_per_m / (2.0 * lifting_n_per_m(devices))

    def stroke_m(u: Array) -> Array:
        share = np.where(offset > 0.0, (u - offset) / np.where(u > 0.0, u, 1.0), 1.0)
        return np.asarray(np.sqrt(half**2 + side * share * (1.0 - u * u)) - half)

    below, above = offset, np.minimum(np.cbrt(offset) + offset, 1.0)
    for _ in range(60):
        u = 0.5 * (below + above)
        stroke = stroke_m(u)
        rises = side * (offset + offset * u * u - 2.0 * u**3) * (1.0 - u * u) > 4.0 * u**3 * stroke * (stroke + half)
        below, above = np.where(rises, u, below), np.where(rises, above, u)
    return stroke_m(below)


def snap_voltage_v(devices: Devices, stroke_m: float) -> Array:
    """Voltage (n, 3) at which a comb that is held at a stroke snaps sideways: 2 F (y_0 + q) / g^2 reaches what the bent
    spring holds, with F as of fingers in the middle.
    """
    lateral = devices.lateral_n_per_m / (1.0 + (stroke_m / (_BENT * devices.leaf_m)) ** 2)
    pull = side_left(devices.side_offset) * lateral * devices.side_gap_m**2 / (2.0 * (devices.overlap_m + stroke_m))
    return np.asarray(np.sqrt(pull / (devices.comb_n_per_v2 * (1.0 - devices.side_offset**2))))


def needed_voltage_v(devices: Devices, strokes_m: Array) -> Array:
    """Highest of the comb voltages (n,) that hold strokes (3,) or (n, 3); NaN where a comb would have to push."""
    force = pose_of_strokes(devices, strokes_m)[0].holding_n
    pull = np.where(np.abs(force) < 1e-12, 0.0, force)
    return np.asarray(np.sqrt(np.where(pull >= 0.0, pull, np.nan) / devices.comb_n_per_v2).max(axis=1))


def corner_voltage_v(devices: Devices, low_m: float, high_m: float | Array) -> Array:
    """Voltage (n,) of the corner of the strokes from ``low_m`` to ``high_m``, () or (n,), that takes most; infinite
    where one takes a push.
    """
    ends = np.array(np.broadcast_arrays(low_m, high_m, np.empty(len(devices)))[:2])
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    strokes = np.moveaxis(ends[corners], 1, 2)  # (corner, device, chain)
    of = np.tile(np.arange(len(devices)), len(corners))
    volt = needed_voltage_v(devices.take(of), strokes.reshape(-1, 3)).reshape(len(corners), -1)
    return np.asarray(np.where(np.isnan(volt), np.inf, volt).max(axis=0, initial=0.0))


def held_stroke_m(devices: Devices, top_v: Array, low_m: float, high_m: float, limit_v: float) -> Array:
    """Stroke (n,) up to which a voltage holds every set of strokes, ``high_m`` where it holds all of them.

    What a corner needs grows with the strokes, so the cube of strokes is halved down to where its worst corner is held;
    ``low_m`` where not even that is.
    """
    held = np.full(len(devices), high_m)
    short = np.flatnonzero(~(top_v <= limit_v))
    if not len(short):
        return held
    some = devices.take(short)
    below, above = np.full(len(short), low_m), np.full(len(short), high_m)
    for _ in range(40):
        middle = 0.5 * (below + above)
        fits = corner_voltage_v(some, low_m, middle) <= limit_v
        below, above = np.where(fits, middle, below), np.where(fits, above, middle)
    held[short] = below
    return held
