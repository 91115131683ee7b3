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
