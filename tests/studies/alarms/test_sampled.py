"""What is kept of the sampled devices (``docs/tables/alarms.jsonl``) covers every law and motion, is a false alarm
nowhere, and is what the devices do today.
"""

import numpy as np
import pytest
from loop_rig import bus, stage
from sampled import (
    KEPT,
    LAWS,
    MOTIONS,
    SCENARIOS,
    SWING_LEAST_M,
    asks_too_much,
    is_stable,
    judge,
    read,
    stopped,
    swings,
    who_may_be_stopped,
)

from pkxyz_ctrl.config.files import names
from pkxyz_ctrl.design.model.loop_plant import Perturbation
from pkxyz_ctrl.loop.row import ROW


def test_every_shipped_law_and_motion_is_among_them():
    """With 500 devices each, but where a stage is too slow for a law."""
    kept = read(KEPT)
    assert set(LAWS) == set(names("controllers"))
    assert {law for _, law in kept} == set(LAWS)
    assert {motion for motion, _ in kept} == {*MOTIONS, *SCENARIOS} == {*MOTIONS, *names("scenarios")} - {"faults"}
    assert set(kept) == {(motion, law) for motion in (*MOTIONS, *SCENARIOS) for law in LAWS}
    refused = {key for key, found in kept.items() if "refused" in found}
    assert refused == {
        (f"{way}_lab", law) for way in ("raster", "circle", "frames") for law in ("robust", "robust_20k")
    }
    assert {found["devices"] for key, found in kept.items() if key not in refused} == {500}


def test_nobody_is_stopped_who_has_a_stable_loop_and_can_get_there():
    assert {key: found["false"] for key, found in read(KEPT).items() if found["false"]} == {}


def test_only_what_asks_too_much_of_the_combs_is_out_of_reach():
    """The stiffest with the weakest combs near the top, and a push; limits that feedback drives them to are not."""
    rows = np.zeros(5, ROW)
    rows["saturated"] = 1
    top, middle = (stage().forward_kinematics(np.full(3, um * 1e-6)) for um in (24.0, 12.5))
    poor = Perturbation(stiffness=0.2, comb_gain=(-0.1, 0.1, 0.1))
    for at_m, device, is_beyond in ((top, poor, True), (top, Perturbation(), False), (middle, poor, False)):
        rows["reference_m"] = at_m
        assert asks_too_much(stage(), device, rows, bus().period_s) is is_beyond
    rows["reference_m"][:, 2] += 0.05e-6 * np.arange(5) ** 2  # 2.5 m/s2 takes a tenth more, and down it is a push
    assert not asks_too_much(stage(), Perturbation(), rows, bus().period_s)
    rows["reference_m"][:, 2] = middle[2] - 50e-6 * np.array([0.0, 0.1, 0.4, 0.5, 0.5])
    assert asks_too_much(stage(), Perturbation(), rows, bus().period_s)


@pytest.mark.parametrize("seed", [230, 391, 460])
def test_a_slow_bus_leaves_more_room_for_forces_that_are_seen_late(seed):
    """With the 32 uN of a fast one they were stopped, at 2 kHz, and nothing is wrong with them."""
    assert stopped("moves", "youla", seed, "classic_2k") is None


def test_behind_the_labs_chain_who_is_stopped_has_no_stable_loop():
    """hinf swings there at 1.25 kHz until limits bind: it is no saturation, though the combs end at their limits."""
    kept = read(KEPT)["raster_lab", "hinf"]
    assert kept["beyond"] == []
    assert 30 < len(kept["unstable"]) < 60
    assert not any(is_stable("raster_lab", "hinf", seed) for seed in kept["unstable"][:8])
    calm = [seed for seed in range(1, 21) if seed not in kept["unstable"]]
    assert sum(is_stable("raster_lab", "hinf", seed) for seed in calm) >= len(calm) - 1
    assert judge("raster_lab", "hinf", kept["unstable"][0]) == "unstable"


@pytest.mark.parametrize("seed", [411, 484])
def test_a_loop_that_swings_is_told_as_one_though_its_linear_plant_is_stable(seed):
    """The two whose Ms, 7 to 1700, is finite: the oscillation grows by a third and by three each 25 ms."""
    assert judge("raster", "robust_20k", seed) == "unstable"


def test_what_does_not_grow_up_to_something_is_no_swing():
    rows, t = np.zeros(2000, ROW), np.arange(2000)
    for size, is_one in (
        (SWING_LEAST_M * np.exp(t / 1000), True),
        (np.full(2000, 1e-6), False),
        (1e-12 * t, False),
        (1e-6 * np.exp(t / 5000), False),
    ):
        rows["position_m"][:, 2] = size * np.sin(0.3 * t)
        assert swings(rows) is is_one


@pytest.mark.parametrize("motion", ["moves", "circles", "raster_harsh"])
@pytest.mark.parametrize("law", ["youla", "irc", "open_loop", "robust"])
def test_devices_fare_today_as_is_kept(motion, law):
    """Three that were stopped, if so many were, and three that were not."""
    kept = read(KEPT)[motion, law]
    known = {seed: verdict for verdict in ("beyond", "unstable", "false") for seed in kept[verdict]}
    calm = [seed for seed in range(1, kept["devices"] + 1) if seed not in known]
    for seed in [*sorted(known)[:3], *calm[:3]]:
        assert judge(motion, law, seed) == known.get(seed)


@pytest.mark.parametrize(("motion", "law"), [("raster_harsh", "open_loop"), ("moves", "hinf")])
def test_who_is_stopped_beside_others_is_stopped_alone(motion, law):
    seeds = range(1, 25)
    among = who_may_be_stopped(motion, law, seeds)
    assert among == [seed for seed in seeds if stopped(motion, law, seed) is not None]
