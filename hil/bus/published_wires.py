"""Wires that python-can finds by a name, for as long as they live."""

from weakref import WeakValueDictionary

from hil.bus.wire import Wire

_by_channel: "WeakValueDictionary[str, Wire]" = WeakValueDictionary()


def publish(wire: Wire, channel: str) -> None:
    """Let ``can.Bus(interface="pkxyz-sim", channel=channel)`` find this wire. Raises ValueError for another's name."""
    if _by_channel.get(channel, wire) is not wire:
        raise ValueError(f"channel {channel!r} is another wire's")
    _by_channel[channel] = wire


def find_wire(channel: str) -> Wire | None:
    """The living wire published as ``channel``."""
    return _by_channel.get(channel)
