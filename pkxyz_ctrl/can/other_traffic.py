"""Frames on the bus that are not the amplifier's: counted, so that a fault which they cause can name them."""

from collections import Counter

from . import cob_id
from .driver_config import DriverConfig
from .frame import Frame

_FLOOD_FRAMES = 5  # fewer say nothing
_FLOOD_PER_S = 2000  # more than this, on average, since the amplifier was last heard; a full classic bus carries 9000


class OtherTraffic:
    """Who else talks, since the amplifier's last sense frame or since the start-up began."""

    def __init__(self, config: DriverConfig) -> None:
        node_id = config.node_id
        services = (base + node_id for base in (cob_id.EMCY_BASE, cob_id.SDO_RESPONSE_BASE, cob_id.HEARTBEAT_BASE))
        self._of_the_amplifier = frozenset((cob_id.sense(node_id, config.sense_pdo), *services))
        self._frames: Counter[int] = Counter()
        self._since_us = self._last_us = 0

    def note(self, frame: Frame, t_us: int) -> None:
        """A frame that was read at ``t_us`` and was not a sense frame."""
        if frame.can_id not in self._of_the_amplifier:
            self._frames[frame.can_id] += 1
            self._last_us = t_us

    def forget(self, t_us: int) -> None:
        """All is well at ``t_us``."""
        if self._frames:
            self._frames.clear()
        self._since_us = t_us

    @property
    def complaint(self) -> str:
        """``; the bus is flooded: ...`` where others send so much that the amplifier may go unheard, else empty."""
        count, time_us = self._frames.total(), self._last_us - self._since_us
        if count < _FLOOD_FRAMES or count * 1_000_000 < _FLOOD_PER_S * time_us:
            return ""
        busiest, _ = self._frames.most_common(1)[0]
        return (
            f"; the bus is flooded: {count} frames that are not the amplifier's in {time_us / 1000:.3g} ms, most of "
            f"them 0x{busiest:03X}: silence their sender"
        )
