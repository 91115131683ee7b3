"""Frames of a scan as a client iterates over them: each tick of the real path in the pixel where its line had it."""

import asyncio
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.client.reply import AbortedError, Command, StageError
from pkxyz_ctrl.client.scan import PATH_ROW, Frames
from pkxyz_ctrl.client.stage import AsyncStage

LINES = [(100, 200, 0), (220, 320, 0), (340, 440, 0), (500, 600, 1), (620, 720, 1), (740, 840, 1)]
"""First and last row of the path, and frame: two of three lines each."""
BACKWARD = [False, True, False] * 2
PIXELS = 8


def rows_of(path_row):
    """Telemetry whose values tell the path's row, so that a pixel's mean tells which rows fell into it."""
    row = np.asarray(path_row, np.float64)
    return {PATH_ROW: row, "tick": np.arange(len(row)), "estimate_m": np.stack([row, -row, 2.0 * row], axis=1)}


def blocks_of(columns, cuts):
    edges = [0, *sorted(cuts), len(columns["tick"])]
    return [Block(a, {k: v[a:b] for k, v in columns.items()}) for a, b in pairwise(edges) if b > a]


def expected(number, columns):
    """By a loop over ticks: sum and count of each pixel."""
    lines = [n for n, line in enumerate(LINES) if line[2] == number]
    sums, ticks = np.zeros((3, PIXELS, 3)), np.zeros((3, PIXELS), np.int64)
    for row, value in zip(columns[PATH_ROW], columns["estimate_m"], strict=True):
        for at, n in enumerate(lines):
            first, last, _ = LINES[n]
            if np.isfinite(row) and first <= row < last:
                share = (row - first) / (last - first)
                share = 1.0 - share if BACKWARD[n] else share
                pixel = min(int(share * PIXELS), PIXELS - 1)
                sums[at, pixel] += value
                ticks[at, pixel] += 1
    with np.errstate(invalid="ignore"):
        return sums / ticks[..., None], ticks


@settings(max_examples=40, deadline=None)
@given(st.floats(0.3, 3.0), st.lists(st.integers(1, 300), max_size=12))
def test_each_tick_falls_into_its_pixel_however_the_blocks_are_cut(speed, cuts):
    path = np.arange(0.0, 900.0, speed)
    columns = rows_of(np.concatenate([[np.nan] * 5, path, [np.nan] * 5]))
    frames = Frames(LINES, BACKWARD, PIXELS)
    assert frames.count == 2
    given_ = [f for block in blocks_of(columns, cuts) for f in frames.take(block, ["estimate_m"])]
    assert [f.number for f in given_] == [0, 1]
    for frame in given_:
        values, ticks = expected(frame.number, columns)
        assert np.array_equal(frame.ticks, ticks)
        np.testing.assert_allclose(frame["estimate_m"], values, rtol=1e-12)


def test_a_frame_comes_with_the_row_that_ends_its_last_line_and_not_before():
    frames = Frames(LINES, BACKWARD, PIXELS)
    assert frames.take(Block(0, rows_of(np.arange(0.0, 440.0))), ["estimate_m"]) == []
    (frame,) = frames.take(Block(440, rows_of([440.0])), ["estimate_m"])
    assert frame.number == 0
    assert frame.ticks.sum() == 300


class Connection:
    """What a server says during a scan, block by block; of ``Connection`` what ``frames`` uses."""

    def __init__(self, blocks, lines=LINES, end="done"):
        self.blocks, self.lines, self.end = blocks, lines, end
        self.said, self.is_listening = [], False

    async def preview(self, path):
        return {"name": "raster", "lines": self.lines, "backward": BACKWARD}

    def listen(self):
        self.is_listening, queue = True, asyncio.Queue()
        queue.put_nowait(Block(0, {"tick": np.zeros(1), PATH_ROW: np.full(1, np.nan), "estimate_m": np.zeros((1, 3))}))
        self.queue = queue
        return queue

    async def unlisten(self, queue):
        self.is_listening = False

    def asked(self):
        return len(self.said), asyncio.Queue()

    def forget(self, tag):
        pass

    async def say(self, message):
        self.said.append(message)

    async def done(self, verb, arguments, *, wait=True):
        assert (verb, wait, self.is_listening) == ("path", False, True)  # nothing of the scan is missed
        for block in self.blocks:
            self.queue.put_nowait(block)
        answers = asyncio.Queue()
        if self.end != "done":
            answers.put_nowait(Command(1, "path", self.end, "stopped by hand"))
        command = Command(1, "path", "running", "")
        command.answers = answers
        return command

    async def ended(self, command):
        return Command(1, "path", self.end, "stopped by hand").require_done()


def iterated(connection):
    async def main():
        stage = AsyncStage("http://127.0.0.1:9", "", control=False)
        stage._connection = connection
        return [frame async for frame in stage.frames("raster", fields=["estimate_m"], pixels=PIXELS)]

    return asyncio.run(asyncio.wait_for(main(), 20.0))


def test_iterating_gives_every_frame_and_ends_with_the_scan():
    columns = rows_of(np.arange(0.0, 900.0))
    connection = Connection(blocks_of(columns, [200, 450, 451, 700]))
    frames = iterated(connection)
    assert [f.number for f in frames] == [0, 1]
    for frame in frames:
        assert np.array_equal(frame.ticks, expected(frame.number, columns)[1])
    assert connection.said[0] == {
        "do": "subscribe",
        "fields": ["tick", PATH_ROW, "estimate_m"],
        "precision": "f8",
        "tag": 0,
    }
    assert not connection.is_listening


def test_a_path_without_lines_lost_rows_and_a_scan_that_is_stopped_are_told():
    with pytest.raises(StageError, match="raster has no lines"):
        iterated(Connection([], lines=[]))
    lost = Block(0, rows_of(np.arange(0.0, 50.0)), lost=3)
    with pytest.raises(StageError, match="rows were lost"):
        iterated(Connection([lost]))
    stopped = Connection(blocks_of(rows_of(np.arange(0.0, 300.0)), []), end="aborted")
    with pytest.raises(AbortedError, match="stopped by hand"):
        iterated(stopped)
    assert not stopped.is_listening
