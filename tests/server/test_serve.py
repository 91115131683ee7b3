"""``pkxyz serve`` as it is started: plant, loop and server, each a process, and clients over loopback."""

import contextlib
import http.client
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from command_line import Server, alive, driven, served
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect as plain_connect
from websockets.typing import Subprotocol

from hil.recording.recording import Recording
from hil.server.app import CLIENTS_MOST
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.protocol import SUBPROTOCOL, TOKEN_PREFIX
from pkxyz_ctrl.client.reply import RefusedError
from pkxyz_ctrl.safety.modes import Mode

pytestmark = pytest.mark.at_rate


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with served(tmp_path_factory.mktemp("serve")) as server:
        yield server


def address() -> tuple[str, str]:
    found = place.read("stage", "server")
    assert found is not None
    return urlsplit(found["url"]).netloc, found["token"]


def shake(token: str, **keywords: object) -> None:
    netloc, _ = address()
    offered = [Subprotocol(SUBPROTOCOL), Subprotocol(TOKEN_PREFIX + token)]
    with plain_connect(f"ws://{netloc}/stage", subprotocols=offered, proxy=None, **keywords):
        pass


def test_the_first_program_anyone_writes(server):
    with alive() as stage:
        driven(stage)
        command = stage.move_to(x=1e-6)
        assert command.state == "done"
        assert command.words.startswith("in position at (1, 0, 18) um")
        assert np.allclose(stage.wait_in_position().position_m, [1e-6, 0, 18e-6], atol=50e-9)
        with pytest.raises(RefusedError, match=r"x = 50 um is asked for, limits -13\.51 to 13\.51 um"):
            stage.move_to(x=50e-6)
        stage.park()
        while stage.status.activity != "off":  # the tick of the answer may be a moment old
            time.sleep(0.01)
        assert (stage.status.voltage_v == 0).all()


def test_a_capture_begins_where_its_trigger_says(server):
    with alive() as stage:
        driven(stage)
        stage.move_to(x=-1e-6)
        stage.move_to(x=1e-6, velocity_m_per_s=10e-6, wait=False)
        block = stage.capture("reference_m", seconds=0.1, trigger=("reference_x_m", "rises above", 0.0), before_s=0.03)
        assert len(block) == 100
        x = block["reference_m"][:, 0]
        assert x[29] <= 0.0 < x[30]
        assert (np.diff(block["tick"]) == 1).all()
        assert np.allclose(np.diff(x[10:90]), 10e-9, rtol=0.02)


def test_a_path_is_paused_and_resumed_over_the_wire(server):
    with alive() as stage:
        driven(stage)
        stage.follow("raster", wait=False)
        while stage.status.progress < 0.2:
            time.sleep(0.01)
        assert stage.pause().words.startswith("stands on its path at")
        assert stage.resume().state == "done"
        while stage.status.activity in ("scanning", "paused"):
            time.sleep(0.02)
        assert stage.status.last_fault == ""


@pytest.mark.parametrize(
    ("token", "keywords"),
    [
        ("", {}),
        ("wrong", {}),
        (None, {"origin": "http://evil.example"}),
        (None, {"origin": "null"}),
        (None, {"additional_headers": {"Host": "evil.example"}}),
    ],
)
def test_nobody_gets_in_without_the_token_or_from_another_page(server, token, keywords):
    with pytest.raises(InvalidStatus, match=r"40[03]"):
        shake(address()[1] if token is None else token, **keywords)


def test_the_page_comes_without_token_and_nothing_beside_it(server):
    netloc, token = address()
    with contextlib.closing(http.client.HTTPConnection(netloc, timeout=5)) as http_client:

        def status_of(path: str, **headers: str) -> tuple[int, bytes]:
            http_client.request("GET", path, headers=headers)
            answer = http_client.getresponse()
            body = answer.read()
            assert "default-src 'self'" in (answer.headers["Content-Security-Policy"] or "") or answer.status == 403
            return answer.status, body

        status, body = status_of("/")
        assert status == 200
        assert token.encode() not in body
        for path in (
            "/../app.py",
            "/%2e%2e/app.py",
            "/..%2fapp.py",
            "//etc/passwd",
            "/stage",
            "/.git/config",
            "/\\..\\app.py",
        ):
            assert status_of(path)[0] in (400, 404), path
        assert status_of("/", Host="evil.example")[0] == 403
        assert status_of("/", Origin="http://evil.example")[0] == 403


def test_two_hundred_connections_that_read_nothing_leave_the_others_alone(server):
    netloc, token = address()
    host, _, port = netloc.partition(":")
    shaking = (
        f"GET /stage HTTP/1.1\r\nHost: {netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: {SUBPROTOCOL}, {TOKEN_PREFIX}{token}\r\n\r\n"
    ).encode()
    with alive() as stage, contextlib.ExitStack() as stack:
        connections = [stack.enter_context(socket.create_connection((host, int(port)), 10)) for _ in range(200)]
        for each in connections:
            with contextlib.suppress(OSError):
                each.sendall(shaking)
        answers = []
        for each in connections:
            with contextlib.suppress(OSError):
                answers.append(each.recv(12))
        assert answers.count(b"HTTP/1.1 101") <= CLIENTS_MOST
        assert len(answers) > 0
        driven(stage)
        assert stage.move_to(x=0.5e-6).state == "done"


def test_a_fault_leaves_its_rows_and_frames_and_is_named(server):
    with alive() as stage:
        driven(stage)
        saved_before = stage.next_status().saved
        time.sleep(2.1)  # of what is kept, nothing is of a fault before
        stage.release()
        end_s = time.monotonic() + 20
        while stage.next_status().saved == saved_before and time.monotonic() < end_s:
            pass
        assert stage.status.saved != saved_before
        folder = Path(stage.status.saved)
        assert folder.parent == server.err.parent / "runs"
        kept = Recording.open(folder / "recording.parquet")
        assert kept["mode"][0] != Mode.FAULT == kept["mode"][-1]
        ticks, frames = kept.ticks, (folder / "frames.log").read_text().splitlines()
        assert len(frames) > 2 * ticks  # sense and SYNC, and drive while there were some
        assert sum(" 080#" in line for line in frames) == pytest.approx(ticks, rel=0.05)
        stage.clear()
        saved = Path(stage.save(0.2).words)
        assert Recording.open(saved / "recording.parquet").ticks == 200
        driven(stage)


def test_a_server_that_is_killed_in_a_scan_leaves_a_stage_that_holds(server):
    """Its successor finds the same loop, in the same run, without a fault, standing."""
    with alive() as stage:
        driven(stage)
        stage.follow("raster", wait=False)
        while stage.status.progress < 0.2:
            time.sleep(0.01)
        before_s = stage.status.t_s
        loop = place.read("stage", "loop")
        server.process.kill()
        server.process.wait(5)
    time.sleep(0.3)
    server.start()
    with alive() as stage:
        assert place.read("stage", "loop") == loop
        assert stage.status.t_s > before_s
        assert stage.status.last_fault == ""
        assert stage.status.activity == "holding"
        position = stage.status.target_m
        assert position[2] > 15e-6
        assert stage.move_to(x=0.0, y=0.0, z=18e-6).state == "done"


def test_the_next_start_has_another_token_and_brings_in_no_library_to_compile_with(server):
    with alive(control=False):  # all is compiled and designed
        before = address()[1]
    assert server.end() == 0
    server.start()
    shake(address()[1])
    with pytest.raises(InvalidStatus, match=r"40[03]"):
        shake(before)
    with alive(control=False):
        for kind in ("server", "loop", "plant"):
            assert "/scipy/linalg/" not in Path(f"/proc/{place.read('stage', kind)['pid']}/maps").read_text(), kind


def test_at_the_end_nothing_is_left(server):
    """Neither of a server that found its loop running, nor of one that started it itself."""
    for _ in range(2):
        with alive(control=False):
            pids = [place.read("stage", kind)["pid"] for kind in ("loop", "plant")]
        assert server.end() == 0
        end_s = time.monotonic() + 5
        for pid in pids:
            while place._is_alive(pid) and time.monotonic() < end_s:
                time.sleep(0.02)
            assert not place._is_alive(pid), Path(f"/proc/{pid}/stat").read_text()
        assert not list(place.folder().glob("*.json"))
        assert "Traceback" not in server.err.read_text()
        server.start()  # the last of them is the fixture's to end
