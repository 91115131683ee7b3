"""What is said of each code that a person may meet."""

import json

import pytest
from command_line import pkxyz

from hil.screen.fault_codes import CLEARS, EMERGENCY_CAUSES, explained, stem, trips
from pkxyz_ctrl.safety.trips import Trip


def test_every_trip_is_explained_by_its_name_and_all_of_a_kind_by_their_common_one():
    assert set(trips()) == {trip.name for trip in Trip}
    assert set(CLEARS) == {stem(trip.name or "") for trip in Trip}
    assert [words.name for words in explained("comb_force")] == ["COMB_FORCE_1", "COMB_FORCE_2", "COMB_FORCE_3"]
    for words in trips().values():
        assert all(words), words


@pytest.mark.parametrize("code", sorted(EMERGENCY_CAUSES))
def test_an_emergency_that_has_words_of_its_own_is_told_by_them(code):
    assert [words.cause for words in explained(f"0x{code:04x}")] == [EMERGENCY_CAUSES[code][0]]


def test_another_emergency_is_told_by_its_class():
    (told,) = explained("0x2310")
    assert told.name == "0x2310"
    assert "current" in told.happened
    assert "short" in told.cause


@pytest.mark.parametrize("code", ["0x10000", "0xzz", "SENSE", "", "8130x"])
def test_what_is_no_code_is_refused_in_a_line(code, tmp_path):
    assert explained(code) == []
    done = pkxyz("explain", code, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "`pkxyz explain` lists all faults" in done.stderr


def test_without_a_code_all_faults_are_told(tmp_path):
    done = pkxyz("explain", "--json", cwd=tmp_path)
    assert [found["name"] for found in json.loads(done.stdout)] == list(trips())
