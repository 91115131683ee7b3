"""What the server does again and again: look, show, tell, keep."""

import asyncio

import pytest
from operated_rig import Script
from test_desk import DeskRig, switched_on

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


def test_the_loop_is_looked_at_often_while_it_has_something_to_say_or_would_stop_in_silence(tmp_path, monkeypatch):
    rig = DeskRig(tmp_path, monkeypatch)
    client = rig.desk.enter()

    def script() -> Script:
        assert not rig.desk.is_waited_for
        yield from switched_on(rig, client)
        rig.desk.tell_status()
        assert not rig.desk.is_waited_for  # it holds
        rig.ask(client, do="move", x_m=2e-6)
        assert rig.desk.is_waited_for
        yield from rig.wait_s(0.002)
        rig.desk.tell_status()
        rig.desk.leave(client)
        assert rig.desk.is_waited_for  # whoever asked is gone, and it still moves
        yield from rig.wait_s(0.2)
        rig.desk.tell_status()
        assert not rig.desk.is_waited_for
        rig.desk.link.description["on_silence"] = "park"
        rig.desk.tell_status()
        assert rig.desk.is_waited_for

    rig.play(script())


def test_where_it_is_is_told_half_as_often_while_nothing_happens_and_at_once_when_something_does(tmp_path, monkeypatch):
    rig = DeskRig(tmp_path, monkeypatch)
    client = rig.desk.enter()

    def told() -> list[str]:
        rig.desk.tell_status(is_in_turn=True)
        return [status["activity"] for status in rig.heard(client).get("status", [])]

    def script() -> Script:
        yield from switched_on(rig, client)
        yield from rig.wait_s(0.1)
        told()
        seen = []
        for _ in range(6):
            yield from rig.wait_s(0.01)
            seen += [told()]
        assert sorted(seen) == [[], [], [], ["holding"], ["holding"], ["holding"]]
        rig.ask(client, do="move", x_m=2e-6, velocity_m_per_s=50e-6)
        for _ in range(3):
            yield from rig.wait_s(0.008)
            assert told() == ["moving"], "every time while it moves"
        for _ in range(2):
            rig.desk.tell_status()
            assert rig.heard(client)["status"], "where something has ended, it is told whatever was told before"

    rig.play(script())


def test_a_client_that_asks_for_much_is_not_refused_what_the_loop_has_taken_since_the_last_look(tmp_path, monkeypatch):
    rig = DeskRig(tmp_path, monkeypatch)
    client = rig.desk.enter()
    rig.desk.look()
    rig.ask(client, do="take_control")
    rig.every_tick.clear()

    def script() -> Script:
        for _ in range(150):
            rig.ask(client, do="quiet", on=True)
            yield
        rig.desk.look()
        answers = [a["state"] for a in rig.heard(client)["answer"] if a["verb"] == "quiet"]
        assert sorted(answers) == ["accepted"] * 150 + ["done"] * 150

    rig.play(script())
