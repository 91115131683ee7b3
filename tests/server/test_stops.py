"""A stop while something is being prepared: it does not wait, and nothing begins behind it."""

import asyncio
import json
from typing import Any

import pytest
from operated_rig import Script
from test_desk import DeskRig, switched_on

from hil.operate.commands import Activity
from hil.server.messages import is_urgent


@pytest.fixture
def rig(tmp_path, monkeypatch):
    return DeskRig(tmp_path, monkeypatch)


def test_only_what_stops_overtakes():
    assert is_urgent('{"do": "stop", "tag": 3}')
    assert is_urgent('{"do": "release"}')
    for text in ('{"do": "move"}', "[]", "{", '"stop"', '{"do": "stop", "x": "' + "a" * 1000 + '"}'):
        assert not is_urgent(text)


def test_what_is_planned_while_somebody_stops_does_not_begin(rig):
    """A stop does not wait for a plan that takes seconds, and the plan is not carried out behind it."""
    holder, other = rig.desk.enter(), rig.desk.enter()

    def script() -> Script:
        yield from switched_on(rig, holder)
        plan = rig.desk._plan

        async def plan_during_which_somebody_stops(function: Any, *arguments: Any) -> Any:
            await rig.desk.ask(other, json.dumps({"do": "stop"}))
            return await plan(function, *arguments)

        rig.desk._plan = plan_during_which_somebody_stops
        answer = yield from rig.finish(holder, do="path", scenario="raster")
        assert answer["state"] == "refused"
        assert "stopped after this was asked" in answer["words"]
        before = rig.desk.stops
        asyncio.run(rig.desk.ask(holder, json.dumps({"do": "move", "x_m": 1e-6, "tag": 9}), before - 1))
        assert [a["state"] for a in rig.heard(holder)["answer"] if a["tag"] == 9] == ["refused"]
        yield from rig.wait_s(0.05)
        assert rig.session.state["activity"] == Activity.HOLDING

    rig.play(script())


def test_a_stop_has_a_number_and_is_done_when_the_stage_stands(rig):
    """It was said to be done as soon as the loop had been told. Two within a tick are one to the loop, and both end."""
    holder, other = rig.desk.enter(), rig.desk.enter()

    def script() -> Script:
        yield from switched_on(rig, holder)
        rig.ask(holder, do="move", x_m=8e-6, velocity_m_per_s=500e-6, tag="m")
        yield from rig.wait_s(0.005)
        assert rig.session.state["activity"] == Activity.MOVING
        rig.heard(holder)
        for client in (other, holder):
            rig.ask(client, do="stop", tag="s")
        first = rig.heard(holder)["answer"]
        assert [a["state"] for a in first] == ["accepted", "accepted"]
        while rig.session.state["activity"] == Activity.MOVING:
            yield
        while rig.session.state["activity"] != Activity.HOLDING:
            assert not any(a["verb"] == "stop" and a["state"] == "done" for a in rig.heard(holder).get("answer", []))
            yield
        yield from rig.wait_s(0.01)
        for client in (other, holder):
            answers = [a for a in rig.heard(client)["answer"] if a["tag"] == "s"]
            assert answers[-1]["state"] == "done"
            assert answers[-1]["words"].startswith("stands at (")
            assert answers[-1]["id"] in {a["id"] for a in first}

    rig.play(script())


def test_a_stop_ends_though_the_loop_has_stood_still(rig, monkeypatch):
    """The memory is there, and nobody ticks: whoever asks is told, and does not wait for ever."""
    client = rig.desk.enter()

    def script() -> Script:
        yield from rig.wait_s(0.01)
        monkeypatch.setattr("hil.server.link._GONE_S", 0.0)
        rig.ask(client, do="stop", tag="s")
        answers = [a for a in rig.heard(client)["answer"] if a["tag"] == "s"]
        assert [a["state"] for a in answers] == ["accepted", "aborted"]
        assert "does not tick" in answers[-1]["words"]

    rig.play(script())
