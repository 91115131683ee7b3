"""What is started beside a server, and what becomes of it: with scripts in place of the loop and the plant."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.commands.operation import serve
from hil.server.beside import Served, started
from pkxyz_ctrl.client import place
from pkxyz_ctrl.config.files import ConfigError

_PROCESS = """#!/bin/sh
trap 'echo "$3 ended" >> "{log}"; exit 0' TERM
echo "$3" >> "{log}"
while :; do sleep 0.02; done
"""


@pytest.fixture
def log(tmp_path, monkeypatch) -> Iterator[Path]:
    """Which processes there were, by the command that each was to run, as they begin and end; of a user whose stages
    are in a folder of its own.
    """
    log, script = tmp_path / "log", tmp_path / "python"
    script.write_text(_PROCESS.format(log=log), encoding="utf-8")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    before = signal.getsignal(signal.SIGTERM)
    yield log
    signal.signal(signal.SIGTERM, before)


def served(port: int = 0) -> Served:
    return Served(
        "stage", "reconstructed", "youla", "nominal", "unix_1k", "hold", 0.25, Path("runs"), "127.0.0.1", port, True
    )


def begun(log: Path, *commands: str) -> None:
    """Wait until they are there."""
    end_s = time.monotonic() + 20
    while not log.exists() or not {*commands} <= {*log.read_text().split()}:
        assert time.monotonic() < end_s
        time.sleep(0.01)


def places() -> list[str]:
    return [kind for kind in ("server", "loop", "plant") if place.read("stage", kind) is not None]


class GaveUpError(Exception):
    """Of the server that is tested with."""


def test_a_port_in_use_is_refused_and_nothing_is_started(log):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f"--port {port}: .*in use"), started(served(port)):
            pytest.fail("nothing is there to serve")
    assert places() == []
    assert not log.exists()


def test_a_second_server_is_refused_and_leaves_the_first_alone(log):
    with started(served()) as first:
        begun(log, "plant", "operate")
        with pytest.raises(ConfigError, match="a server for 'stage' is running already"), started(served()):
            pytest.fail("there is one already")
        assert first.ended is None
        assert place.read("stage", "server") == {"pid": os.getpid(), "url": first.url, "token": first.token}
    assert log.read_text().splitlines()[2:] == ["operate ended", "plant ended"]


@pytest.mark.parametrize("error", [GaveUpError, KeyboardInterrupt, SystemExit])
def test_a_server_that_fails_ends_the_loop_then_the_plant_and_forgets_them(log, error):
    with contextlib.suppress(error), started(served()) as beside:
        begun(log, "plant", "operate")
        assert places() == ["server", "plant"]  # the loop says itself where it is
        raise error
    assert log.read_text().splitlines()[2:] == ["operate ended", "plant ended"]
    assert places() == []
    with socket.create_server(("127.0.0.1", beside.port)):
        pass  # it is free again


def test_one_that_ends_by_itself_is_named(log):
    with started(served()) as beside:
        begun(log, "plant", "operate")
        assert beside.ended is None
        found = place.read("stage", "plant")
        assert found is not None
        os.kill(found["pid"], 9)
        end_s = time.monotonic() + 20
        while beside.ended is None:
            assert time.monotonic() < end_s
        assert beside.ended == "plant"


def test_a_loop_of_a_server_before_is_found_and_ended_with_this_one(log, tmp_path):
    loop = subprocess.Popen([sys.executable, "-m", "hil", "operate"])
    try:
        begun(log, "operate")
        place.write("stage", "loop", {"pid": loop.pid})
        with started(served()):
            assert log.read_text().split() == ["operate"]
        assert log.read_text().splitlines() == ["operate", "operate ended"]
        assert loop.wait(5) == 0
    finally:
        loop.kill()


def test_each_start_has_another_token(log):
    tokens = set()
    for _ in range(3):
        with started(served()) as beside:
            tokens.add(beside.token)
    assert len(tokens) == 3
    assert min(map(len, tokens)) >= 32


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_end_while_the_server_is_loaded_comes_behind_that_is_no_error_and_leaves_nothing(log, monkeypatch, number):
    """Within an import it was another error each time, and exit codes of 130, or of a signal that nobody had sent."""
    loaded = []

    def asked_to_end(*, quiet: bool) -> None:
        begun(log, "plant", "operate")
        signal.raise_signal(number)
        loaded.append("whole")

    monkeypatch.setattr(serve, "say_if_compiling", asked_to_end)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has it ignored by what it runs behind
    assert serve.serve_beside(served(), lambda url: pytest.fail(f"told of {url}"), quiet=True) == 0
    assert loaded == ["whole"]
    assert log.read_text().splitlines()[2:] == ["operate ended", "plant ended"]
    assert places() == []


def test_what_begins_first_waits_for_nothing_that_the_server_alone_needs():
    """They were begun a second later, as it loaded numba and its own modules before."""
    heavy = "numpy", "numba", "uvicorn", "starlette", "hil.screen"
    code = f"import sys, hil.server.beside; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
