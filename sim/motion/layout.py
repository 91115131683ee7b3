"""Memory of the plant: one record of parameters, one of state, which njit kernels and plain code share.

Suffixes are units; chains and axes have three entries. What a kernel may scribble on is in the state as well, so that
no kernel allocates."""

import numpy as np

from sim.config.structure import MODES_MAX
from sim.motion.nystrom import STAGES

KNOTS = 64
"""Remembered ends of steps, for the sense chain's delay."""
MODES = MODES_MAX
"""Flexible modes at most."""
SIZE = 3 + MODES
"""Coordinates of table and flexible modes."""
TONES = 72
"""Lines of floor and mains at most."""
FLICKERS = 8
"""Relaxations that make up 1/f noise."""
INSTANTS = 4
"""Of a step of the usual length, at which forces are looked at: as many as a processor's vectors hold."""
CUBIC = 4
"""Coefficients over a call of ``advance``, of t^0 to t^3."""
EVENTS = 64
"""Events kept; later ones are only counted."""

SENSE_STREAM = 0  # and 1, 2: one per channel
BROWNIAN_STREAM = 3
DRIFT_STREAM = 4
SENSE_DRIFT_STREAM = 5  # and 6, 7
BASE_STREAM = 8
AMPLIFIER_STREAM = 9
AMPLIFIER_FLICKER_STREAM = 10
SENSE_FLICKER_STREAM = 11
FLOOR_STREAM = 12
MAINS_STREAM = 13
STREAMS = 14

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
        # a step of the usual length: sim.motion.collocation
        ("regular_s", "f8"), ("stiff_per_s2", "f8", (3, 3)),  # K / m at rest
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
        ("sense_chain_noise_f", "f8"),  # of what passes the filter
        ("crosstalk_on", "i8"), ("crosstalk_own_f_per_v", "f8"), ("crosstalk_others_f_per_v", "f8"),
        ("crosstalk_rate_f_per_v_per_s", "f8"),
        # what takes the general step: sim.structure.general_step
        ("general_on", "i8"), ("longest_s", "f8"),
        ("mode_count", "i8"), ("mode_comb", "f8", (MODES, 3)), ("mode_table", "f8", (MODES, 3)),
        ("mode_per_kg", "f8", MODES), ("mode_w2_per_s2", "f8", MODES), ("mode_damping_per_s", "f8", MODES),
        ("general_response_1_s2", "f8", (SIZE, SIZE)), ("general_response_2_s2", "f8", (SIZE, SIZE)),
        ("general_response_1", "f8", (SIZE, SIZE)), ("general_response_2", "f8", (SIZE, SIZE)),
        ("misaligned_on", "i8"), ("aside_m", "f8", 3), ("finger_gap_m", "f8"), ("lateral_n_per_m", "f8"),
        ("softening_m", "f8"),
        ("tilt_on", "i8"), ("tilt_shift", "f8", (3, 3)),
        # surroundings
        ("shaken_on", "i8"), ("base_m_per_s2_per_rt_hz", "f8", 3), ("tone_count", "i8"),
        ("tone_rad_per_s", "f8", TONES), ("tone_m_per_s2", "f8", TONES), ("tone_v", "f8", TONES),
        ("tone_f", "f8", TONES),
        ("amplifier_noise_on", "i8"), ("amplifier_v_per_rt_hz", "f8"), ("amplifier_flicker_v", "f8"),
        ("amplifier_flicker_per_s", "f8", FLICKERS),
        ("sense_flicker_on", "i8"), ("sense_flicker_f", "f8"), ("sense_flicker_per_s", "f8", FLICKERS),
        ("slow_on", "i8"), ("warm_k", "f8"), ("warming_k", "f8"), ("warming_s", "f8"), ("swing_k", "f8"),
        ("swing_rad_per_s", "f8"), ("stiffness_per_k", "f8"), ("comb_per_k", "f8"), ("sense_per_k", "f8"),
        ("ageing_from_s", "f8"), ("ageing_s", "f8"), ("ageing_springs", "f8", 3), ("ageing_combs", "f8", 3),
        ("drawn_leaf_n_per_m", "f8", 3), ("drawn_crank_hinge_nm", "f8", 3), ("drawn_link_hinge_nm", "f8"),
        ("drawn_force_gain_n_per_v2", "f8", 3), ("drawn_sense_f_per_m", "f8", 3),
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
        ("knot_t_us", "f8", KNOTS), ("knot_m", "f8", (KNOTS, 3)), ("knot_m_per_s", "f8", (KNOTS, 3)), ("knot_count",
        "i8"), ("event_count", "i8"), ("event_t_us", "i8", EVENTS), ("event_kind", "i8", EVENTS), ("event_chain",
        "i8", EVENTS), ("random", "u8", (STREAMS, 4)), ("spare", "f8", (STREAMS, 2)),
        ("modes", "f8", (2, MODES)),  # coordinates (m) and rates (m/s) of the flexible modes
        ("tone_phase", "f8", (TONES, 3, 2)),  # cosine and sine, by axis or channel
        ("amplifier_flicker", "f8", (3, FLICKERS)), ("sense_flicker", "f8", (3, FLICKERS)),  # in deviations
        ("sense_chain_noise", "f8", 3), ("sense_white", "f8", 3),  # in deviations
        # the mechanism's strokes, how its cranks and links lie, and the pose that these belong to
        ("slider_m", "f8", 3), ("slider_tangent", "f8", 3), ("slider_steep", "f8"), ("slider_at_m", "f8", 3),
        ("filtered_v", "f8", 3),
        ("aside_m", "f8", 3), ("comb_rise", "f8", 3),  # what fingers bend aside, and what that does to their force
        ("rise_line", "f8", (3, 3)),  # ... tangent by chain: constant, per V^2, per m of stroke
        # over a call of advance
        ("call_s", "f8"), ("shake_m_per_s2", "f8", (CUBIC, 3)), ("ripple_v", "f8", (CUBIC, 3)),
        ("tone_turn_dt_us", "i8"), ("tone_turn", "f8", (TONES, 2)),
        # scratch of one step
        ("force_n", "f8", 3), ("steady_n", "f8", 3),
        ("base_v", "f8", 3), ("slope_v_per_s", "f8", 3), ("error_v", "f8", 3), ("volt2", "f8", 3),
        ("error_volt2", "f8", 3), ("fast_1_m", "f8", 3), ("fast_2_m", "f8", 3), ("fast_1_m_per_s2", "f8", 3),
        ("fast_2_m_per_s2", "f8", 3), ("slopes", "f8", (STAGES, 3)), ("start", "f8", 6),
        # ... of the usual length; instants stand last, in the record that is written: of these LLVM makes vectors
        ("flow_h_s", "f8"), ("instant_decay", "f8", INSTANTS), ("solved", "f8", (6, INSTANTS)),
        ("from_pose", "f8", (6, INSTANTS)), ("from_rate", "f8", (6, INSTANTS)), ("steady", "f8", (6, INSTANTS)),
        ("answer", "f8", (INSTANTS, 6, INSTANTS)), ("end_rate", "f8", (2 + INSTANTS, 6)),
        ("to_end", "f8", (12, INSTANTS)), ("smooth", "f8", 6), ("free_m", "f8", (3, INSTANTS)),
        ("instant_volt2", "f8", (3, INSTANTS)),
        ("fast_m", "f8", (3, INSTANTS)), ("fast_m_per_s2", "f8", (3, INSTANTS)), ("left_m_per_s2", "f8", (3, INSTANTS)),
        ("near", "f8", INSTANTS), ("pose_m", "f8", (3, INSTANTS)), ("ended", "f8", (6, INSTANTS)),
        ("ended_m", "f8", 3), ("ended_m_per_s2", "f8", 3),  # pose and acceleration where the last one ended
        # ... of any other
        ("tabulated_h_s", "f8"), ("decay", "f8", STAGES), ("shrink", "f8", (STAGES, 3, 3)), ("swell", "f8", (STAGES, 3,
        3)), ("contact", "i8"), ("touched", "i8", 3),
        ("z", "f8", SIZE), ("rate", "f8", SIZE), ("z_at", "f8", SIZE), ("rate_at", "f8", SIZE),
        ("pull", "f8", SIZE), ("change", "f8", SIZE), ("general_one", "f8", SIZE), ("general_two", "f8", SIZE),
        ("general_one_push", "f8", SIZE), ("general_two_push", "f8", SIZE), ("general_slopes", "f8", (STAGES, SIZE)),
        ("mode_h_s", "f8"), ("mode_shrink", "f8", (STAGES, MODES)), ("comb_n", "f8", 3), ("start_modes", "f8", (2,
        MODES)), ("pose", "f8", 6), ("tone_sum", "f8", (2, 2, 3)),
        ("before_m", "f8", 3), ("before_m_per_s", "f8", 3), ("strokes_m", "f8", 3), ("rates_m_per_s", "f8", 3),
    ],
    align=True,
)  # fmt: skip
