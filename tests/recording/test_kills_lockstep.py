"""Some of the kills of ``kills_lockstep.py``, and that it sees what must not be; ``make kills`` makes ten thousand."""

import kills_lockstep
import pytest

from hil.node.amplifier import AmplifierNode


@pytest.mark.slow
def test_whoever_is_killed_the_combs_are_at_0_v_in_time(tmp_path):
    kills = kills_lockstep.Kills(30, 7, tmp_path)
    kills.run()
    assert kills.failures == []
    assert sum(kills.outcomes.values()) >= 25
    assert len(kills.outcomes) >= 4
    assert kills.modes["TRACKING"] >= 5


@pytest.mark.slow
def test_an_amplifier_that_keeps_its_voltage_without_us_is_seen(tmp_path, monkeypatch):
    """Planted: nothing of what it does by itself releases the combs."""
    monkeypatch.setattr(AmplifierNode, "_release_combs", lambda node: None)
    monkeypatch.setattr(AmplifierNode, "_outputs_to_error_value", lambda node: None)
    kills = kills_lockstep.Kills(20, 7, tmp_path)
    kills.run()
    assert any("though nobody controls them" in told for told in kills.failures)


def test_a_recording_cut_at_any_byte_opens_with_its_whole_rows(tmp_path):
    refused = kills_lockstep.cut_recordings(60, 3, tmp_path)
    assert 5 < refused < 30
