"""Whoever listens to telemetry, and no longer wants to."""

import asyncio

import numpy as np
import pytest
from test_frames import Connection

from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.client.stage import AsyncStage


@pytest.mark.parametrize("is_a_block_coming", [False, True])
def test_who_is_cancelled_stops_listening_even_as_a_block_comes(is_a_block_coming):
    """In Python 3.11 ``asyncio.wait_for`` returns what came in the same moment, and the cancellation is lost."""
    connection = Connection([])

    async def main() -> None:
        stage = AsyncStage("http://127.0.0.1:9", "", control=False)
        stage._connection = connection  # type: ignore[assignment]

        async def listen() -> None:
            async for _ in stage.telemetry("estimate_m"):
                pass

        listening = asyncio.create_task(listen())
        await asyncio.sleep(0.01)
        if is_a_block_coming:
            connection.queue.put_nowait(Block(1, {"tick": np.ones(1), "estimate_m": np.zeros((1, 3))}))
        listening.cancel()
        done, _ = await asyncio.wait([listening], timeout=1.0)
        assert done
        assert listening.cancelled()
        assert not connection.is_listening

    asyncio.run(main())
