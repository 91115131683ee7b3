"""What is kept of the sampled devices (``docs/tables/alarms.jsonl``) covers every law and motion, is a false alarm
nowhere, and is what the devices do today.
"""

import numpy as np
import pytest
from sampled import KEPT, LAWS, MOTIONS, SCENARIOS, SWING_LEAST_M, judge, read, swings

from pkxyz_ctrl.config.files import names
from pkxyz_ctrl.loop.row import ROW


def test_every_shipped_law_and_motion_is_among_them():
    """Not yet 500 devices of every pair of them: the page's table says how many."""
    kept = read(KEPT)
    assert set(LAWS) == set(names("controllers"))
    assert {law for _, law in kept} == set(LAWS)
    assert {motion for motion, _ in kept} == {*MOTIONS, *SCENARIOS} == {*MOTIONS, *names("scenarios")} - {"faults"}


def test_nobody_is_stopped_who_has_a_stable_loop_and_can_get_there():
    assert {key: found["false"] for key, found in read(KEPT).items() if found["false"]} == {}


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
