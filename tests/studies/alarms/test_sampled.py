"""What is kept of the sampled devices (``docs/tables/alarms.jsonl``) covers every law and motion, is a false alarm
nowhere, and is what the devices do today.
"""

import pytest
from sampled import KEPT, LAWS, MOTIONS, SCENARIOS, judge, read

from pkxyz_ctrl.config.files import names


def test_every_shipped_law_and_motion_is_among_them():
    """Not yet every pair of them: the page's table says how many."""
    kept = read(KEPT)
    assert set(LAWS) == set(names("controllers"))
    assert {law for _, law in kept} | {"robust_20k"} == set(LAWS)  # which has a bus of its own, and is not yet there
    assert {motion for motion, _ in kept} == {*MOTIONS, *SCENARIOS} == {*MOTIONS, *names("scenarios")} - {"faults"}


def test_nobody_is_stopped_who_has_a_stable_loop_and_can_get_there():
    assert {key: found["false"] for key, found in read(KEPT).items() if found["false"]} == {}


@pytest.mark.parametrize("motion", ["moves", "circles", "raster_harsh"])
@pytest.mark.parametrize("law", ["youla", "irc", "open_loop", "robust"])
def test_devices_fare_today_as_is_kept(motion, law):
    """Three that were stopped, if so many were, and three that were not."""
    kept = read(KEPT)[motion, law]
    known = {seed: verdict for verdict in ("beyond", "unstable", "false") for seed in kept[verdict]}
    calm = [seed for seed in range(1, kept["devices"] + 1) if seed not in known]
    for seed in [*sorted(known)[:3], *calm[:3]]:
        assert judge(motion, law, seed) == known.get(seed)
