"""What waits for a client that reads slowly, or not at all."""

import asyncio
import contextlib
import socket

import numpy as np
import pytest

from hil.server.beside import _bound
from hil.server.client import SAID_MOST, Client, Moment
from pkxyz_ctrl.client.protocol import Block, packed

pytestmark = pytest.mark.at_rate


def test_one_that_opens_recordings_and_reads_nothing_fills_no_memory():
    """Each is counted as a block that waits, and leaves room again once it is taken."""
    client, block = Client(1), Block(0, {"estimate_m": np.zeros((4, 3))}, 0)
    shown = 0
    while client.has_room:
        client.show_opened({"name": "x"}, block)
        shown += 1
    assert shown == 4
    client.fields, moment = ("estimate_m",), Moment(0, {"estimate_m": np.zeros((4, 3))})
    client.show(moment)
    assert client.lost == 4
    for _ in range(2 * shown):
        asyncio.run(client.next_said())
    assert client.said.empty()
    client.show(moment)
    assert (client.lost, client.said.qsize()) == (0, 1)


def test_the_system_keeps_little_for_one_that_reads_nothing():
    """What it keeps comes before every answer. It was 3.9 MB: 40 s of telemetry for a page that was slow."""
    listening = _bound("127.0.0.1", 0)
    with listening, socket.create_connection(listening.getsockname()):
        accepted, _ = listening.accept()
        with accepted:
            accepted.setblocking(False)
            kept = 0
            with contextlib.suppress(BlockingIOError):
                while kept < 50_000_000:
                    kept += accepted.send(bytes(4096))
    assert 30_000 < kept < 400_000


def test_one_that_is_slow_is_told_where_the_stage_is_now_and_not_where_it_was():
    """A page on a machine without a core to spare was some 40 s behind, then thrown out for what waited."""
    client = Client(1)
    for n in range(3):
        client.tell_status(f"status {n}")
    client.tell({"answer": "done"})
    client.tell_status("status 3")
    said = []
    while not client.said.empty():
        said.append(asyncio.run(client.next_said()))
    assert said == ["status 3", '{"answer": "done"}']
    client.tell_status("status 4")
    assert asyncio.run(client.next_said()) == "status 4"
    for n in range(10 * SAID_MOST):
        client.tell_status(f"status {n}")
    assert (client.said.qsize(), client.is_hopeless) == (1, False)


def test_what_clients_see_alike_is_packed_once_and_is_what_each_asked_for():
    """By fields, precision and rows lost; each one's block is what it would be alone."""
    values = {"estimate_m": np.arange(12.0).reshape(4, 3), "tick": np.arange(4)}
    asked = [(("estimate_m",), "f4", 0), (("tick", "estimate_m"), "f8", 0), (("estimate_m",), "f4", 7)]
    moment = Moment(5, values)
    for fields, precision, lost in asked:
        clients = [Client(n) for n in range(3)]
        for client in clients:
            client.fields, client.precision, client.lost = fields, precision, lost
            client.show(moment)
        first, *others = (asyncio.run(client.next_said()) for client in clients)
        assert all(other is first for other in others)
        assert first == packed(Block(5, {name: values[name] for name in fields}, lost), precision)
        assert [client.lost for client in clients] == [0, 0, 0]
