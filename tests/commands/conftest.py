"""Each test of a command has a terminal of its own: its width is read once, by whoever prints first."""

from collections.abc import Iterator

import pytest

from hil.screen import terminal


@pytest.fixture(autouse=True)
def a_screen_of_its_own() -> Iterator[None]:
    terminal.screen.cache_clear()
    yield
    terminal.screen.cache_clear()
