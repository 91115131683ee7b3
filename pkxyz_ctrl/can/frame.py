"""One CAN frame, as our own code carries it."""

from typing import NamedTuple


class Frame(NamedTuple):
    """A CAN frame without time and without channel: what is on the wire, nothing else.

    A tuple, because a frame is made several times a tick and a python-can ``Message`` costs ten times as much.
    ``data`` holds 0..8 bytes (classic) or 0..64 bytes in one of the FD lengths; ``can_id`` has 11 bits, or 29 if
    ``is_extended``. ``bitrate_switch`` has a meaning for FD frames only (ISO 11898-1).
    """

    can_id: int
    data: bytes
    is_fd: bool = False
    bitrate_switch: bool = False
    is_remote: bool = False
    is_extended: bool = False
    is_error: bool = False
