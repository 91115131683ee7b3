"""What waits for a client that reads slowly, or not at all."""

import asyncio

import numpy as np

from hil.server.client import Client
from pkxyz_ctrl.client.protocol import Block


def test_one_that_opens_recordings_and_reads_nothing_fills_no_memory():
    """Each is counted as a block that waits, and leaves room again once it is taken."""
    client, block = Client(1), Block(0, {"estimate_m": np.zeros((4, 3))}, 0)
    shown = 0
    while client.has_room:
        client.show_opened({"name": "x"}, block)
        shown += 1
    assert shown == 4
    client.show(block)
    assert client.lost == 4
    for _ in range(2 * shown):
        asyncio.run(client.next_said())
    assert client.said.empty()
    client.show(block)
    assert (client.lost, client.said.qsize()) == (0, 1)
