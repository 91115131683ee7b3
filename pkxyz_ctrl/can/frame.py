"""One CAN frame, as our own code carries it."""

from typing import Final, NamedTuple, Self

# what ``Frame.flags`` is made of
FD: Final = 1
BIT_RATE_SWITCH: Final = 2
REMOTE: Final = 4
EXTENDED: Final = 8
ERROR: Final = 16
FD_FAST: Final = FD | BIT_RATE_SWITCH  # how process data go over an FD bus
UNUSUAL: Final = REMOTE | EXTENDED | ERROR  # not a data frame with an 11-bit identifier


class _Fields(NamedTuple):
    can_id: int
    data: bytes
    flags: int


class Frame(_Fields):
    """A CAN frame without time and without channel: what is on the wire, nothing else.

    A tuple, because a frame is made several times a tick and a python-can ``Message`` costs ten times as much.
    ``data`` holds 0..8 bytes (classic) or 0..64 bytes in one of the FD lengths; ``can_id`` has 11 bits, or 29 if
    extended. The bit-rate switch has a meaning for FD frames only (ISO 11898-1). ``_make`` takes the three fields.
    """

    __slots__ = ()

    def __new__(
        cls,
        can_id: int,
        data: bytes,
        is_fd: bool = False,
        bitrate_switch: bool = False,
        is_remote: bool = False,
        is_extended: bool = False,
        is_error: bool = False,
    ) -> Self:
        flags = (
            (FD if is_fd else 0)
            | (BIT_RATE_SWITCH if bitrate_switch else 0)
            | (REMOTE if is_remote else 0)
            | (EXTENDED if is_extended else 0)
            | (ERROR if is_error else 0)
        )
        return tuple.__new__(cls, (can_id, data, flags))

    def __reduce__(self) -> tuple[object, tuple[tuple[int, bytes, int]]]:  # for copies, and for other processes
        return Frame._make, ((self.can_id, self.data, self.flags),)

    @property
    def is_fd(self) -> bool:
        return self.flags & FD != 0

    @property
    def bitrate_switch(self) -> bool:
        return self.flags & BIT_RATE_SWITCH != 0

    @property
    def is_remote(self) -> bool:
        return self.flags & REMOTE != 0

    @property
    def is_extended(self) -> bool:
        return self.flags & EXTENDED != 0

    @property
    def is_error(self) -> bool:
        return self.flags & ERROR != 0
