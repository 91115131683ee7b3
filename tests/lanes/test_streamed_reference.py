"""Streamed rows are the trajectory's, bit for bit, and no tick waits for more than a piece of them."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.lanes.blocks import PREVIEW_ROWS
from hil.lanes.streamed_reference import BLOCK_ROWS, PIECE_ROWS, StreamedReference
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.trajectory import Trajectory


@pytest.fixture(scope="module")
def trajectory():
    return load_scenario("raster").trajectory


def rows_seen(reference, memory):
    """The rows that the cycle would read in this tick."""
    rows = reference(0)
    at = int(memory["reference_tick"][0] - rows["tick"][0])
    assert 0 <= at <= len(rows) - PREVIEW_ROWS
    return rows[at : at + PREVIEW_ROWS].copy()


@settings(max_examples=20)
@given(st.data())
def test_every_tick_sees_its_rows(trajectory, data):
    """Ticks that wait at a row (enabled, not tracking yet), go on by one, and begin anew from the first."""
    period_us = data.draw(st.sampled_from([200, 333, 1000]))
    waits = set(data.draw(st.lists(st.integers(0, 3 * BLOCK_ROWS), max_size=5)))
    anew = set(data.draw(st.lists(st.integers(1, 3 * BLOCK_ROWS), max_size=2)))
    whole = reference_rows(trajectory.sample(0, 3 * BLOCK_ROWS + PREVIEW_ROWS, period_us))
    memory = new_memory()
    reference = StreamedReference(trajectory, period_us, memory)
    for tick in range(3 * BLOCK_ROWS):
        at = int(memory["reference_tick"][0])
        assert rows_seen(reference, memory).tobytes() == whole[at : at + PREVIEW_ROWS].tobytes()
        reference.prepare()
        if tick in anew:
            memory["reference_tick"] = 0
        elif tick not in waits:
            memory["reference_tick"] += 1


def test_the_end_of_the_trajectory_stands_still(trajectory):
    memory = new_memory()
    reference = StreamedReference(trajectory, 1000, memory)
    for at in range(trajectory.duration_us // 1000 + 3 * BLOCK_ROWS):
        memory["reference_tick"] = at
        last = rows_seen(reference, memory)
        reference.prepare()
    assert (last["motion"] == np.array([*trajectory.end_m, *np.zeros(6)])).all()


def test_no_tick_samples_more_than_a_piece(trajectory, monkeypatch):
    sampled = []
    sample = trajectory.sample
    memory = new_memory()
    reference = StreamedReference(trajectory, 200, memory)
    monkeypatch.setattr(trajectory, "sample", lambda first, n, period: sampled.append(n) or sample(first, n, period))
    for at in range(4 * BLOCK_ROWS):
        memory["reference_tick"] = at
        reference(at)
        reference.prepare()
    assert max(sampled) == PIECE_ROWS
    assert sum(sampled) >= 4 * BLOCK_ROWS


def test_a_piece_of_a_long_trajectory_costs_no_more_than_of_a_short_one(trajectory):
    """As many motions as an hour of scanning has: what is not on is not looked at."""
    (scan,) = [s for s in load_scenario("raster").config.reference if s.kind == "raster"]
    lead = load_scenario("raster").config.reference[1]
    long = Trajectory([lead, *(scan.model_copy() for _ in range(60))])
    fastest_s = {}
    for name, which in (("short", trajectory), ("long", long)):
        took_s = []
        for n in range(200):
            begin_s = time.perf_counter()
            which.sample(2000 + n, PIECE_ROWS, 200)
            took_s.append(time.perf_counter() - begin_s)
        fastest_s[name] = min(took_s)
    assert fastest_s["long"] < 2 * fastest_s["short"] + 20e-6
