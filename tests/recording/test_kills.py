"""Some of the random kills of ``kills.py`` and ``kills_at_rate.py``, and that the latter see what must not be."""

import kills
import kills_at_rate
import pytest

from hil.node.amplifier import AmplifierNode


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.slow
def test_a_killed_run_leaves_what_opens_and_says_that_it_is_cut(tmp_path, seed):
    assert kills.kill_one(seed, tmp_path) in ("no recording yet", "cut off, and says so", "whole")


@pytest.fixture(scope="module")
def at_rate(tmp_path_factory):
    folder = tmp_path_factory.mktemp("at_rate")
    kills_at_rate.prepared(folder)
    return folder


@pytest.mark.parametrize(
    ("what", "left"),
    [
        (("controller", "killed", "tracking"), "cut off, and says so"),
        (("recorder", "killed", "tracking"), "cut off, and says so"),
        (("plant", "stopped", "fault"), "whole"),
    ],
)
@pytest.mark.slow
def test_whoever_is_killed_at_rate_the_combs_are_at_0_v_in_time_and_the_recording_says_what_it_lacks(
    at_rate, what, left
):
    assert kills_at_rate.the_first(at_rate, *what).outcome() == left


@pytest.mark.slow
def test_an_amplifier_at_rate_that_keeps_its_voltage_is_seen(at_rate, monkeypatch):
    """Planted: nothing of what it does by itself releases the combs."""
    monkeypatch.setattr(AmplifierNode, "_release_combs", lambda node: None)
    monkeypatch.setattr(AmplifierNode, "_outputs_to_error_value", lambda node: None)
    monkeypatch.setattr(kills_at_rate, "ZERO_S", 1.0)
    with pytest.raises(AssertionError, match="voltage without a controller"):
        kills_at_rate.the_first(at_rate, "controller", "killed", "tracking", begin=100).outcome()
