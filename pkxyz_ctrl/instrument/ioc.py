"""``pkxyz ioc``: the stage for EPICS, three motor records and the verbs of the stage, served by caproto."""

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable
from typing import Any, Final

from caproto import ChannelData
from caproto.asyncio.server import Context

from pkxyz_ctrl.client.reply import NoStageError, StageError, Status
from pkxyz_ctrl.client.stage import AsyncStage
from pkxyz_ctrl.instrument.axis_moves import AXES, AxisMoves
from pkxyz_ctrl.instrument.motor_record import MotorRecord
from pkxyz_ctrl.instrument.records import Whole, Words

VERBS: Final = ("home", "enable", "disable", "park", "clear", "abort", "pause", "resume")
_FREE: Final = ("stop", "release")
PORT: Final = 5064
_LOOPBACK: Final = "127.0.0.1"


def listen_at(host: str, port: int) -> None:
    """Where the server will listen, for caproto, which reads it from the environment: at this address alone, and on
    loopback without a word to any other host.
    """
    os.environ |= {"EPICS_CAS_INTF_ADDR_LIST": host, "EPICS_CA_SERVER_PORT": str(port)}
    if host == _LOOPBACK:
        os.environ |= {"EPICS_CAS_AUTO_BEACON_ADDR_LIST": "NO", "EPICS_CAS_BEACON_ADDR_LIST": _LOOPBACK}


class Ioc:
    """``channels``: all that is served, by name."""

    def __init__(self, stage: AsyncStage, prefix: str) -> None:
        self._stage = stage
        self._moves = AxisMoves(stage)
        self._words = Words(value="", long_string_max_length=1000)
        self._state = Words(value="")
        self._control = Whole(value=0)
        self._control.put = self._put_control
        self._said = ""
        self._motors = [MotorRecord(f"{prefix}{axis}", axis, self._moves, self._say) for axis in AXES]
        self.channels: dict[str, ChannelData] = {}
        for motor in self._motors:
            self.channels |= motor.channels
        for verb in (*VERBS, *_FREE):
            channel = Whole(value=0)
            channel.put = self._putting(verb)
            self.channels[f"{prefix}{verb}"] = channel
        self.channels |= {f"{prefix}words": self._words, f"{prefix}state": self._state}
        self.channels[f"{prefix}control"] = self._control

    def _say(self, words: str) -> None:
        self._said = words

    def _putting(self, verb: str) -> Callable[[Any], Awaitable[None]]:
        async def put(value: Any) -> None:
            if not value:
                return
            try:
                if verb not in _FREE:
                    await self._moves.take_control()
                await getattr(self._stage, verb)()
            except StageError as error:
                self._say(str(error))
                raise

        return put

    async def _put_control(self, value: Any) -> None:
        if value:
            await self._moves.take_control()
        else:
            await self._moves.give_control()
        await self._control.tell(int(bool(value)))

    async def look(self, status: Status) -> None:
        """Tell what is so."""
        await self._state.tell_change(status.activity)
        await self._words.tell_change(self._said or status.last_fault or status.words)
        for motor in self._motors:
            await motor.look(status)


async def serve_ioc(
    stage: AsyncStage, prefix: str, host: str, port: int, tell: Callable[[str], object], ended: asyncio.Event
) -> None:
    """Serve until ``ended``. Raises ``NoStageError`` once the stage is gone."""
    listen_at(host, port)
    logging.getLogger("caproto").setLevel(logging.CRITICAL)  # what is refused is told to who asked
    async with stage:
        while stage.status.activity == "starting" and not ended.is_set():
            await stage.next_status()
        ioc = Ioc(stage, prefix)
        await ioc.look(stage.status)
        context = Context(ioc.channels)
        serving = asyncio.create_task(context.run())
        try:
            tell(f"{prefix}x, {prefix}y, {prefix}z at {host}:{port}")
            while not ended.is_set():
                if serving.done():
                    await serving
                    raise NoStageError("caproto has ended by itself")
                await ioc.look(await stage.next_status())
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
