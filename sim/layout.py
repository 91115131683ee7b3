"""Memory of the plant: one record of parameters, one of state, which njit kernels and plain code share.

Suffixes are units; chains and axes have three entries. What a kernel may scribble on is in the state as well, so that
no kernel allocates."""

import numpy as np

from sim.nystrom import STAGES

KNOTS = 16
"""Remembered ends of steps, for the sense chain's delay."""
EVENTS = 64
"""Events kept; later ones are only counted."""

SENSE_STREAM = 0  # and 1, 2: one per channel
BROWNIAN_STREAM = 3
DRIFT_STREAM = 4
SENSE_DRIFT_STREAM = 5  # and 6, 7
STREAMS = 8

STOP, PULLED_IN, BROKEN = 1, 2, 3
"""Kinds of event: a slider met a stop; a comb's fingers snapped together; the stage left its mechanism's range."""

PARAMS = np.dtype(
    [
        # mechanism
        ("crank_m", "f8"), ("link_m", "f8"), ("projection_rest_m", "f8"), ("height_rest_m", "f8"),
        ("leaf_n_per_m", "f8", 3), ("crank_hinge_nm", "f8", 3), ("link_hinge_nm", "f8"),
        ("mass_kg", "f8"), ("per_kg", "f8"), ("per_crank", "f8"), ("per_link2", "f8"),
        ("damping_per_s", "f8", (3, 3)), ("damping2_per_s2", "f8", (3, 3)),  # D, and D^2 / 4
        ("weight_n", "f8", 3),
        # stops
        ("stop_low_m", "f8"), ("stop_high_m", "f8"), ("stop_n_per_m", "f8"), ("stop_damping_s_per_m", "f8"),
        # drive combs
        ("force_gain_n_per_v2", "f8", 3), ("fringe_per_m", "f8"), ("levitation", "f8"),
        ("overlap_rest_m", "f8"), ("lateral_limit_v2m", "f8", 3),
        ("charging_on", "i8"), ("charging_fraction", "f8"), ("charging_s", "f8"),
        # amplifier
        ("amplifier_s", "f8"), ("slew_v_per_s", "f8"), ("current_a", "f8"), ("stray_f", "f8"),
        ("response_1_s2", "f8", (3, 3)), ("response_2_s2", "f8", (3, 3)),  # of the table to a transient
        ("response_1", "f8", (3, 3)), ("response_2", "f8", (3, 3)),  # ... what of its acceleration that answers
        ("volt_per_count", "f8", 3), ("amplifier_offset_v", "f8", 3), ("dac_step", "i8"),
        # parasitic mode
        ("parasitic_on", "i8"), ("parasitic_rad_per_s", "f8"), ("parasitic_damping_per_s", "f8"), ("parasitic_per_kg",
        "f8"), ("parasitic_comb", "f8", 3), ("parasitic_table", "f8", 3),
        # slow and random forces
        ("drift_on", "i8"), ("drift_n", "f8", 3), ("drift_s", "f8"), ("drift_walk_n_per_rt_s", "f8"),
        ("brownian_n_rt_s", "f8", 3),
        # sense chain
        ("sense_f_per_m", "f8", 3), ("sense_curvature_per_m", "f8"), ("sense_rest_f", "f8"), ("sense_offset_f", "f8",
        3), ("sense_noise_f", "f8"), ("sense_filter_s", "f8"), ("sense_delay_us", "f8"), ("sense_walk_f_per_rt_s",
        "f8"), ("feedthrough_f_per_v", "f8"), ("count_f", "f8"), ("count_zero_f", "f8"), ("adc_step", "i8"),
    ],
    align=True,
)  # fmt: skip

STATE = np.dtype(
    [
        ("t_us", "i8"),
        ("motion", "f8", 6),  # position (m) and velocity (m/s) of the rigid mechanism
        ("voltage_v", "f8", 3), ("target_v", "f8", 3), ("charge_v", "f8", 3),
        ("external_n", "f8", 3), ("parasitic", "f8", 2),
        ("drift_walk_n", "f8", 3), ("sense_walk_f", "f8", 3),
        ("filtered_m", "f8", 3),
        ("held", "i8", 3), ("held_m", "f8", 3), ("touching", "i8", 3), ("broken", "i8"),
        ("knot_t_us", "i8", KNOTS), ("knot_m", "f8", (KNOTS, 3)), ("knot_m_per_s", "f8", (KNOTS, 3)), ("knot_count",
        "i8"), ("event_count", "i8"), ("event_t_us", "i8", EVENTS), ("event_kind", "i8", EVENTS), ("event_chain",
        "i8", EVENTS), ("random", "u8", (STREAMS, 4)), ("spare", "f8", (STREAMS, 2)),
        # scratch of one step
        ("force_n", "f8", 3),
        ("base_v", "f8", 3), ("slope_v_per_s", "f8", 3), ("error_v", "f8", 3), ("volt2", "f8", 3),
        ("error_volt2", "f8", 3), ("fast_1_m", "f8", 3), ("fast_2_m", "f8", 3), ("fast_1_m_per_s2", "f8", 3),
        ("fast_2_m_per_s2", "f8", 3), ("given", "f8", (STAGES, 3)), ("start", "f8", 6),
        ("tabulated_h_s", "f8"), ("decay", "f8", STAGES), ("shrink", "f8", (STAGES, 3, 3)), ("swell", "f8", (STAGES, 3,
        3)), ("contact", "i8"), ("touched", "i8", 3),
        ("before_m", "f8", 3), ("before_m_per_s", "f8", 3), ("strokes_m", "f8", 3), ("rates_m_per_s", "f8", 3),
    ],
    align=True,
)  # fmt: skip
