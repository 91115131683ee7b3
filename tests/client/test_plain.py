"""``Stage`` is ``AsyncStage`` with each call waited for: nothing is missing, and a person is told the same of both."""

import asyncio
import inspect
import threading
from typing import Annotated, Any, get_type_hints

import pytest

from pkxyz_ctrl.client.plain import Stage
from pkxyz_ctrl.client.stage import AsyncStage

VERBS = [name for name, member in vars(AsyncStage).items() if inspect.iscoroutinefunction(member) and name[0] != "_"]


def test_whatever_an_asyncio_program_can_ask_every_program_can():
    public = {name for name in vars(AsyncStage) if not name.startswith("_")}
    assert public == {name for name in vars(Stage) if not name.startswith("_")}
    assert {"home", "move_to", "capture", "take_control"} <= set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_keeps_its_arguments_its_words_and_what_it_returns(verb):
    waited, asked = getattr(Stage, verb), getattr(AsyncStage, verb)
    assert inspect.signature(waited) == inspect.signature(asked)
    assert get_type_hints(waited) == get_type_hints(asked)
    assert inspect.getdoc(waited) == inspect.getdoc(asked)
    assert not inspect.iscoroutinefunction(waited)
    assert waited.__qualname__ == f"Stage.{verb}"


@pytest.mark.parametrize("verb", ["move_to", "move_by", "name_position"])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_length_says_its_unit_where_a_call_is_completed(verb, axis):
    length = get_type_hints(getattr(Stage, verb), include_extras=True)[axis]
    assert length == Annotated[float, "m"] | None


class Echo(AsyncStage):
    """Answers with what it was asked, and where."""

    def __init__(self) -> None:
        super().__init__("http://127.0.0.1:9", "", control=False)

    async def __aenter__(self) -> "Echo":
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def _done(self, verb: str, wait: bool = True, **arguments: Any) -> Any:
        await asyncio.sleep(0)
        return verb, wait, arguments, threading.current_thread()


def test_a_call_waits_for_the_end_of_what_runs_beside_it():
    with Stage(Echo()) as stage:
        verb, wait, arguments, thread = stage.move_to(1e-6, z=2e-6, velocity_m_per_s=1e-3, wait=False)
    assert (verb, wait) == ("move", False)
    assert arguments == {"x_m": 1e-6, "y_m": None, "z_m": 2e-6, "relative": False, "velocity_m_per_s": 1e-3}
    assert thread is not threading.current_thread()
    assert not thread.is_alive()
