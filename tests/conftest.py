"""Shared by all tests: kernels from the cache that is named after their sources, and the same examples in every run."""

import os
from collections.abc import Iterator

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: on a busy machine threads only wait for each other

import pytest
from hypothesis import HealthCheck, settings

import pkxyz_ctrl  # noqa: F401
from hil.pictures import drawing_process
from hil.screen import terminal

# Whether an example is slow is the machine's affair, and no test's.
settings.register_profile(
    "same every time", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("same every time")


@pytest.fixture(autouse=True, scope="session")
def pictures_in_place() -> Iterator[None]:
    """A command that is called within a test draws within it: the cores are busy with other tests."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(drawing_process, "cores", lambda: 1)
        yield


@pytest.fixture(autouse=True)
def a_screen_of_its_own() -> Iterator[None]:
    """Each test has a terminal of its own: its width is read once, by whoever prints first."""
    terminal.screen.cache_clear()
    yield
    terminal.screen.cache_clear()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first, so that no core waits for the other at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
