"""A few of the random kills of ``kills.py``; ``make kills`` does 300."""

import kills
import pytest


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.slow
def test_a_killed_run_leaves_what_opens_and_says_that_it_is_cut(tmp_path, seed):
    assert kills.kill_one(seed, tmp_path) in ("no recording yet", "cut off, and says so", "whole")
