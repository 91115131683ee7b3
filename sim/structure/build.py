"""Parameters of what bends, from the plant file."""

import math

import numpy as np

from sim.config.device import Device
from sim.config.structure import FingerMisalignment, FlexibleModes, TableTilt
from sim.motion.integrator import LONGEST_S
from sim.motion.layout import SIZE

STEPS_A_PERIOD = 6.0
"""General steps in a period of the fastest mode: the order-8 method's own share of the longest rigid step."""


def build_flexible_modes(p: np.void, config: FlexibleModes, rest_n_per_m: np.ndarray) -> None:
    """Modes and the longest step; needs the stiffness (3, 3) at rest."""
    modes = config.modes if config.on else ()
    p["mode_count"] = len(modes)
    p["longest_s"] = LONGEST_S
    for k, mode in enumerate(modes):
        w = 2 * math.pi * mode.frequency_hz
        p["mode_w2_per_s2"][k], p["mode_damping_per_s"][k] = w * w, w / mode.quality_factor
        p["mode_per_kg"][k] = mode.compliance_share * w**2 / rest_n_per_m[0, 0]
        p["mode_comb"][k], p["mode_table"][k] = mode.comb_shape, mode.table_shape
        p["longest_s"] = min(p["longest_s"], 1.0 / (STEPS_A_PERIOD * mode.frequency_hz))


def build_general_response(p: np.void, rest_n_per_m: np.ndarray) -> None:
    """Response of all coordinates to a transient of the amplifier; needs the modes and the damping."""
    kappa = np.hstack([np.eye(3), -p["mode_table"].T])  # of the mechanism's pose by (table, modes)
    stiff = kappa.T @ rest_n_per_m @ kappa * np.concatenate([np.full(3, p["per_kg"]), p["mode_per_kg"]])[:, None]
    stiff[3:, 3:] += np.diag(p["mode_w2_per_s2"])
    d = np.zeros((SIZE, SIZE))
    d[:3, :3], d[3:, 3:] = p["damping_per_s"], np.diag(p["mode_damping_per_s"])
    for n in (1, 2):
        tau = p["amplifier_s"] / n
        response = tau**2 * (np.eye(SIZE) + tau * d - tau**2 * stiff)
        p[f"general_response_{n}_s2"] = response
        if tau > 0.0:
            p[f"general_response_{n}"] = (d / tau - np.eye(SIZE) / tau**2) @ response


def build_misalignment(p: np.void, config: FingerMisalignment, device: Device, lateral_n_per_m: float) -> None:
    """Offsets by size: which side a finger leans to is all one. ``lateral_n_per_m``: of a slider at rest."""
    p["misaligned_on"] = config.on
    p["aside_m"] = np.abs(config.offset_m)
    p["finger_gap_m"] = device.drive_comb.finger_gap_m
    p["lateral_n_per_m"], p["softening_m"] = lateral_n_per_m, config.softening_stroke_m


def build_tilt(p: np.void, config: TableTilt) -> None:
    """(theta_x, theta_y, 0) x arm, by the position."""
    p["tilt_on"] = config.on
    (ax, ay, az), about_x, about_y = (
        config.arm_m,
        np.array(config.about_x_rad_per_m),
        np.array(config.about_y_rad_per_m),
    )
    p["tilt_shift"] = np.array([about_y * az, -about_x * az, about_x * ay - about_y * ax])
