"""The Youla filter's kernel against numpy's convolution, and what it does not do: answer set-points, or run away."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import bus, rows_of, stage

from hil.bench.rigs.motions import MIDDLE_M, setup_of
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.core import youla
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent
from pkxyz_ctrl.design.margins.margins import spectral_radius
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.trajectory import Hold, Steps


def filter_of(taps, fade_ticks=10, quiet_taps=0.0):
    law, state = np.zeros(1, youla.YOULA)[0], np.zeros(1, youla.YOULA_STATE)[0]
    law["tap_n_per_m"][: len(taps)], law["taps"] = taps, len(taps)
    law["fade_ticks"], law["quiet_tap_n_per_m"][: len(taps)] = fade_ticks, quiet_taps
    return law, state


def force_of(law, state, innovation_m, share=1.0):
    out = np.zeros(3)
    youla.note(law, state, innovation_m)
    youla.add_feedback(law, state, share, out)
    return out


@settings(max_examples=30)
@given(st.integers(1, youla.TAPS_MAX), st.integers(0, 2**32 - 1))
def test_the_force_is_the_convolution_of_taps_and_innovations(count, seed):
    """Over three times round the ring."""
    rng = np.random.default_rng(seed)
    taps, innovation = rng.normal(size=(count, 3)), rng.normal(size=(3 * youla.TAPS_MAX, 3))
    law, state = filter_of(taps)
    found = np.array([force_of(law, state, nu, 0.5) for nu in innovation])
    for axis in range(3):
        expected = -0.5 * np.convolve(innovation[:, axis], taps[:, axis])[: len(innovation)]
        assert found[:, axis] == pytest.approx(expected, abs=1e-12)


def test_a_quiet_hold_fades_to_taps_of_its_own_and_back_without_a_step():
    law, state = filter_of(np.full((1, 3), 2.0), fade_ticks=4, quiet_taps=0.4)
    one, found = np.ones(3), []
    for tick in range(14):
        state["quiet"] = 3 <= tick < 8
        found.append(-force_of(law, state, one)[0])
    assert found == pytest.approx([2.0, 2.0, 2.0, 1.6, 1.2, 0.8, 0.4, 0.4, 0.8, 1.2, 1.6, 2.0, 2.0, 2.0])


def test_an_open_loop_leaves_nothing_in_the_filter():
    law, state = filter_of(np.ones((7, 3)))
    for _ in range(9):
        force_of(law, state, np.ones(3))
    youla.clear(state)
    assert force_of(law, state, np.zeros(3)).tolist() == [0.0, 0.0, 0.0]


def test_a_quiet_hold_is_one_only_while_the_set_point_stands_still():
    _, state = filter_of(np.ones((1, 3)))
    still, moving, on = np.arange(9.0) * [1, 1, 1, 0, 0, 0, 0, 0, 0], np.full(9, 1e-6), []
    for wanted, here, later in (
        (True, still, still),
        (False, still, still),
        (True, moving, moving),
        (True, still, moving),
    ):
        youla.ask(state, wanted, here, later)
        on.append(int(state["quiet"]))
    assert on == [1, 0, 0, 0]


@pytest.mark.parametrize("seed", [1, 2])
def test_a_quiet_hold_has_half_the_noise_and_begins_without_a_bump(seed):
    """About the set-point; the fade shows nothing beyond the noise."""
    setup, _ = setup_of([Hold(kind="hold", duration_s=1.0)], "youla", "nominal", MIDDLE_M)
    noise_nm = []
    for quiet in (False, True):
        config = setup.controller.model_copy(
            update={"youla": setup.controller.youla.model_copy(update={"quiet_holds": quiet})}
        )
        rows, result = rows_of(replace(setup, controller=config, seed=seed), "fast")
        assert not result.faults
        begin = setup.trajectory.segments[-1].t_start_us // 200
        error = (rows["position_m"] - rows["reference_m"])[rows["reference_tick"] >= begin - 250][:5000]
        assert np.abs(error[:400]).max() < 5e-9
        noise_nm.append(1e9 * np.sqrt((error[500:] ** 2).mean(axis=0)))
    assert all(0.4 < v < 0.7 for v in noise_nm[1])
    assert all(0.9 < v < 1.02 for v in noise_nm[0])


# -- what follows from it, whatever the taps ---------------------------------------------------------------------------


def shipped(taps_by=1.0):
    config = load("controllers", "youla", ControllerConfig)
    filters = tuple(
        f.model_copy(update={"plane": tuple(taps_by * q for q in f.plane), "z": tuple(taps_by * q for q in f.z)})
        for f in config.youla.filter
    )
    return config.model_copy(update={"youla": config.youla.model_copy(update={"filter": filters})})


@pytest.mark.parametrize("taps_by", [-3.0, 0.0, 10.0])
def test_no_taps_can_make_the_loop_of_the_stage_as_drawn_unstable(taps_by):
    """Its poles are those of the filter and of the regulator alone: even -3 and 10 times the shipped taps add none."""
    alone, changed = (design_law(stage(), shipped(k), bus(), autostart=True) for k in (0.0, taps_by))
    strokes = np.full(3, 12.5e-6)
    plant = loop_plant(stage(), bus(), strokes)
    radius = [spectral_radius(plant, lqg_equivalent(stage(), law, strokes)) for law in (alone, changed)]
    assert radius[0] < 0.995
    assert radius[1] == pytest.approx(radius[0], abs=2e-3)  # 40 zeros of a delay line are ill-conditioned poles


def test_the_answer_to_a_jump_does_not_depend_on_the_filter():
    """A jump of 1 um on the plant as drawn, with the filter, without it and with half of it: what differs is noise."""
    steps = Steps(kind="steps", by_m=(1e-6, 0.0, 1e-6), count=2, dwell_s=0.02)
    setup, _ = setup_of([steps], "youla", "nominal", MIDDLE_M)
    ways = []
    for taps_by in (1.0, 0.5, 0.0):
        rows, result = rows_of(replace(setup, controller=shipped(taps_by)), "fast")
        assert not result.faults
        jump_tick = setup.trajectory.segments[-1].jumps_us[0] // 200
        rows = rows[rows["reference_tick"] >= 0]
        ways.append(rows["position_m"][jump_tick : jump_tick + 90])
    moved = np.abs(ways[0] - ways[0][0]).max(axis=0)
    assert moved[0] > 0.99e-6
    for other in ways[1:]:
        assert np.abs(other - ways[0]).max() < 8e-9  # six deviations of two holds' noise
        assert np.sqrt(((other - ways[0]) ** 2).mean()) < 2e-9
