"""Which laws a stage and a bus can have, as the page offers them, and what is said of those that can't be designed."""

import asyncio
import multiprocessing
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import pytest

from hil.server.app import app_of
from hil.server.designing import CHOICE, Choice, offer_of, refusals
from hil.server.desk import Desk
from hil.server.link import Link
from hil.server.paths import Planner
from pkxyz_ctrl.config.files import ConfigError, find

ON_2K = ("reconstructed", "classic_2k")


def test_what_is_refused_in_advance_is_refused_when_it_is_asked_for_in_the_same_words():
    found = refusals(*ON_2K)
    assert [name for name in CHOICE if not found[name]] == ["youla", "lqg", "pi_notch"]
    assert "period_us is 200 and the bus has 500 us" in found["robust"]
    with pytest.raises(ConfigError) as refused:
        offer_of(*ON_2K, "robust", None, 1)
    assert str(refused.value) == found["robust"]


def test_laws_are_looked_for_once_and_everybody_who_asks_is_told():
    looked, told = [], []

    async def plan(function: Any, *arguments: Any) -> dict[str, str]:
        looked.append((function, *arguments))
        await asyncio.sleep(0)
        return {"youla": ""}

    async def ask() -> None:
        choice = Choice(*ON_2K, plan)
        for name in ("first", "meanwhile"):
            choice.tell(lambda laws, name=name: told.append((name, laws)))
        assert told == [], "nobody waits for it"
        for _ in range(9):
            await asyncio.sleep(0)
        choice.tell(lambda laws: told.append(("late", laws)))
        await asyncio.sleep(0)

    asyncio.run(ask())
    assert looked == [(refusals, *ON_2K)]
    assert told == [(name, {"laws": {"youla": ""}}) for name in ("first", "meanwhile", "late")]


def test_a_server_that_ends_waits_for_no_design(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    desk = Desk(Link("nobody"), Planner(*ON_2K[:1], "youla", ON_2K[1]), asyncio.to_thread, tmp_path)

    async def serve() -> asyncio.Task[Any]:
        app = app_of(desk, "token", frozenset())
        async with app.router.lifespan_context(app):
            designing = asyncio.create_task(asyncio.to_thread(offer_of, *ON_2K, "lqg", None, 1))
            desk._choice.tell(told.append)
            while len(multiprocessing.active_children()) < 2:
                await asyncio.sleep(0.01)
        await asyncio.wait([designing, desk._choice._found])
        await asyncio.sleep(0)
        return designing

    told: list[Any] = []
    assert isinstance(asyncio.run(serve()).exception(), BrokenProcessPool)
    assert told == [{"laws": {}}], "nothing is known of them"
    assert "Traceback" not in capfd.readouterr().err


def test_weights_that_no_gain_fulfils_are_refused_like_any_other_text():
    text = find("controllers", "lqg").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match=r"regulator: the Riccati equation is fulfilled to .* only"):
        offer_of(*ON_2K, "mine", text.replace("position_error_m = 10.0e-9", "position_error_m = 1e-20"), 1)
