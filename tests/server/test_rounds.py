"""What the server does again and again: look, show, tell, keep."""

import asyncio

import pytest

from hil.server.app import Round


@pytest.mark.parametrize("is_slow", [False, True], ids=["at once", "awaited"])
def test_a_round_that_fails_is_told_once_and_tried_again(caplog, is_slow):
    """One exception ended the task of the rounds for good: the page stood still, and nobody was told."""
    calls = []

    def work():
        calls.append(len(calls))
        if calls[-1] in (1, 2, 3, 6):
            raise OSError(f"no space left at call {calls[-1]}")

    async def awaited():
        await asyncio.sleep(0)
        work()

    async def some_rounds():
        each = Round("do this", awaited if is_slow else work)
        while len(calls) < 10:
            await each.go()

    asyncio.run(some_rounds())
    assert ["call 1" in caplog.text, "call 2" in caplog.text, "call 6" in caplog.text] == [True, False, True]
    assert [record.levelname for record in caplog.records] == ["ERROR", "ERROR"]
