"""EPICS channels that ask when they are written: what stands in them is what holds, not what was wished for."""

import math
from collections.abc import Awaitable, Callable
from typing import Any

from caproto import AlarmSeverity, AlarmStatus, ChannelData, ChannelDouble, ChannelEnum, ChannelInteger, ChannelString
from caproto._data import SkipWrite

Put = Callable[[Any], Awaitable[object]]
"""Does what a written value asks for; raises what the client is told."""


class NotWritableError(Exception):
    """A channel that only tells."""


async def _only_tells(value: Any) -> None:
    raise NotWritableError("this field only tells")


class _Asks(ChannelData):
    """``put`` is called by what a client writes, and returns when that is done; ``tell`` is our own way to write."""

    put: Put = staticmethod(_only_tells)

    async def verify_value(self, data: Any) -> Any:
        await self.put(data)
        raise SkipWrite

    async def tell(self, value: Any, **metadata: Any) -> None:
        """A new value to whoever looks on."""
        await self.write(value, verify_value=False, **metadata)

    async def tell_change(self, value: Any) -> None:
        """The same, of what seldom changes: silent if it is as it was."""
        if self.value != value:
            await self.tell(value)


class Number(_Asks, ChannelDouble):
    """A length, speed or time."""

    async def verify_value(self, data: Any) -> Any:
        """Limits are those of the one who is asked, in words."""
        return await _Asks.verify_value(self, data)

    async def tell_limits(self, low: float, high: float) -> None:
        """What its metadata say of the range; none while that is not known."""
        if math.isnan(low) or math.isnan(high):
            low = high = 0.0
        if (self.lower_ctrl_limit, self.upper_ctrl_limit) != (low, high):
            await self.write_metadata(
                lower_ctrl_limit=low, upper_ctrl_limit=high, lower_disp_limit=low, upper_disp_limit=high
            )


class Whole(_Asks, ChannelInteger):
    """A count or a flag."""

    async def verify_value(self, data: Any) -> Any:
        return await _Asks.verify_value(self, data)


class Choice(_Asks, ChannelEnum):
    """One of some words."""

    async def verify_value(self, data: Any) -> Any:
        return await _Asks.verify_value(self, data)


class Words(_Asks, ChannelString):
    """A sentence; what is longer than 40 characters is read as NAME.VAL$ or NAME$."""


async def raise_alarm(channel: ChannelData, is_wrong: bool) -> None:
    """The alarm of a channel: that what was asked did not come about, or none."""
    status, severity = (
        (AlarmStatus.STATE, AlarmSeverity.MAJOR_ALARM) if is_wrong else (AlarmStatus.NO_ALARM, AlarmSeverity.NO_ALARM)
    )
    if channel.alarm.severity != severity:
        await channel.alarm.write(status=status, severity=severity)
