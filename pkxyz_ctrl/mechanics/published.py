"""Every number that "Parallel-kinematics XYZ MEMS Part 1" prints about its device, and how ours is computed.

Units are the paper's: um, mm, mN, N/mm, N mm/rad, mg, Hz. Where the text contradicts itself the entry carries the
other reading; ``reproduction.verdict`` decides, not this file.
"""

from pkxyz_ctrl.elements import flexures
from pkxyz_ctrl.mechanics import published_device
from pkxyz_ctrl.mechanics import readings as read
from pkxyz_ctrl.mechanics.reproduction import Entry
from pkxyz_ctrl.mechanics.sextic import closure_polynomial


def entries() -> list[Entry]:
    """All rows, in the paper's order."""
    return [
        *_kinematics(),
        *_flexures(),
        *_combs(),
        *published_device.dimensions(),
        *published_device.dynamics(),
        *published_device.appendices(),
    ]


def _kinematics() -> list[Entry]:
    return [
        Entry(
            "II.A",
            "solutions of the forward problem",
            "",
            "6",
            lambda s: len(closure_polynomial(s.config.geometry, [0.0] * 3)) - 1,
            "degree of the polynomial after elimination; six real roots generically, one within reach",
        ),
        Entry(
            "Eq. 8",
            "lambda_1 at rest, origin moved 100 um",
            "um",
            lambda s: read.eq_8_moved_um(s, True),
            lambda s: read.eq_8_moved_um(s, False),
            "Y_A0 stands inside the root and belongs outside; harmless in the paper's frame, where it is 0",
            lambda s: (
                read.eq_8_moved_um(s, False),
                (
                    s.config.geometry.base_radius_m
                    - s.config.geometry.projection_rest_m
                    - s.config.geometry.crank_length_m
                )
                * 1e6,
            ),
        ),
        Entry(
            "Eq. 19, 20",
            "K_zz with sec^2[a]^2 and tan^2[a]^2",
            "N/mm",
            lambda s: read.eq_19_n_per_mm(s, 4),
            lambda s: read.hessian_n_per_mm(s, 2),
            "squared once only: then it is the exact energy's Hessian at rest",
            lambda s: (read.eq_19_n_per_mm(s, 2), read.hessian_n_per_mm(s, 2)),
        ),
        Entry(
            "Eq. 23",
            "lift per unit of comb force, names as in the sentence",
            "N/N",
            lambda s: read.lift_per_pull(s, True),
            read.lift_per_pull_by_work,
            "the sentence swaps the two vectors; the formula itself conserves work",
            lambda s: (read.lift_per_pull(s, False), read.lift_per_pull_by_work(s)),
        ),
        Entry(
            "Eq. 35",
            "rise per common stroke, dx = J_1^-1 dlambda",
            "",
            lambda s: read.rise_per_stroke(s, True),
            read.rise_per_stroke_by_closure,
            "inverted: J_1^-1 maps positions to strokes, as in Eq. 9",
            lambda s: (read.rise_per_stroke(s, False), read.rise_per_stroke_by_closure(s)),
        ),
    ]


def _flexures() -> list[Entry]:
    return [
        Entry(
            "Eq. 25",
            "K_1 with K_d = 2 E h t^3 / l^3",
            "N/mm",
            lambda s: read.beams_n_per_mm(s, 1),
            lambda s: read.spring_n_per_m(s) * 1e-3,
            "the next sentence and Eq. 26 have 4 E h t^3 / l^3: two such pairs to each half of a folded spring",
            lambda s: (read.beams_n_per_mm(s, 2), read.spring_n_per_m(s) * 1e-3),
        ),
        Entry(
            "IV.A",
            "K_1",
            "N/mm",
            "0.002938",
            lambda s: read.spring_n_per_m(s) * 1e-3,
            "Eq. 26; the last digit differs by two",
        ),
        Entry(
            "IV.A",
            "K_l1 / K_1",
            "",
            "44900",
            lambda s: read.lateral_n_per_m(s) / read.spring_n_per_m(s),
            "Eq. 26 and 27, three digits",
        ),
        Entry(
            "IV.B",
            "K_2",
            "N mm/rad",
            "2.43e-3",
            lambda s: flexures.crank_hinge_stiffness(s.config.flexures) * 1e3,
            "Eq. 28",
        ),
        Entry(
            "IV.B",
            "theta_max",
            "rad",
            "1.5",
            lambda s: flexures.crank_hinge_range_rad(s.config.flexures),
            "Eq. 29, 30; cut, not rounded",
        ),
        Entry(
            "IV.B",
            "displacement range of the parallelogram",
            "um",
            "4.9e2",
            lambda s: (
                flexures.crank_tip_retreat_m(
                    s.config.geometry.crank_length_m, flexures.crank_hinge_range_rad(s.config.flexures)
                )
                * 1e6
            ),
            "it is L1 (1 - cos theta_max), along the slider; across it would be 500 um",
        ),
        Entry(
            "IV.C",
            "K_3",
            "N mm/rad",
            "6.25e-3",
            lambda s: flexures.link_hinge_stiffness(s.config.flexures) * 1e3,
            "Eq. 31",
        ),
        Entry(
            "IV.C",
            "alpha_max",
            "rad",
            "0.94",
            lambda s: flexures.link_hinge_range_rad(s.config.flexures),
            "Eq. 32; rounded up from 0.933",
        ),
    ]


def _combs() -> list[Entry]:
    return [
        Entry(
            "IV.D",
            "comb force at 130 V",
            "mN",
            "1",
            lambda s: read.comb_force_mn(s, s.config.drive_comb.finger_height_m),
            "Eq. 33 with fingers of 100 um; with the layer's 90 um it is 0.970 mN",
        ),
        Entry(
            "IV.D",
            "finger height",
            "um",
            "100",
            lambda s: s.config.flexures.leaf_height_m * 1e6,
            "the layer that the fingers are etched in is 90 um in IV.A and IV.E",
            lambda s: (90.0, s.config.flexures.leaf_height_m * 1e6),
        ),
        Entry(
            "IV.D",
            "pull-in stroke by Eq. 34",
            "um",
            "7e2",
            lambda s: read.pull_in_um(s, read.spring_n_per_m(s), True),
            "with 20 um of overlap, which the paper does not give; said to be about 700",
        ),
        Entry(
            "Eq. 34",
            "pull-in stroke, overlap taken off the root",
            "um",
            lambda s: read.pull_in_um(s, read.spring_n_per_m(s), True),
            read.pull_in_by_balance_um,
            "the balance gives -y0/2 + sqrt(y0^2/4 + g^2 k_l/2k)",
            lambda s: (read.pull_in_um(s, read.spring_n_per_m(s), False), read.pull_in_by_balance_um(s)),
        ),
        Entry(
            "IV.D",
            "pull-in stroke, all that the comb works against",
            "um",
            "7e2",
            lambda s: read.pull_in_um(s, read.lifting_quarter_n_per_m(s), False),
            "hinges included (Eq. 24) the comb holds itself with eight times the force; still ten strokes",
        ),
    ]
