"""Any python-can bus as ``runtime.Port``. The only place in this package that knows python-can."""

import errno
import logging
import os
import time
from contextlib import suppress
from typing import Any, Protocol

import can

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.config.files import ConfigError

logging.getLogger("can").addHandler(logging.NullHandler())  # what matters of it is in the errors that it raises

_STAMP_MAX_AGE_S = 1.0
_NO_FD = "it carries no FD frames: set it up for them (ip link set ... mtu 72, type can ... fd on), or say fd = false"
_REMEDIES = {
    errno.ENETDOWN: "it is down: ip link set ... up",
    errno.EINVAL: _NO_FD,
    errno.EMSGSIZE: _NO_FD,
    errno.ENOBUFS: "nobody takes what is sent: check power, wiring, termination and bit rates",
    errno.ENODEV: "it has gone: check the adapter's plug",
    errno.ENXIO: "it has gone: check the adapter's plug",
}


_ERROR_BUS_OFF = 0x40  # class of an error frame (linux/can/error.h); the next one, of a restart, has another
_BUS_OFF = "check wiring, termination and bit rates, then restart it (ip link set ... type can restart)"
_SAYS_NOTHING_OF_FD = ("virtual",)  # it carries them, and calls itself classic


class _Time(Protocol):
    @property
    def now_us(self) -> int: ...


def open_bus(config: CanConfig, name: str) -> can.BusABC:
    """The bus that a bus config named ``name`` describes. Raises ``ConfigError`` with the interface's own words."""
    keywords: dict[str, Any] = {"bitrate": config.nominal_bitrate_bit_per_s}
    if config.driver.fd:
        keywords |= {"fd": True, "data_bitrate": config.data_bitrate_bit_per_s}
    keywords |= config.options or {}
    try:
        opened = can.Bus(channel=config.channel, interface=config.interface, **keywords)
    except NameError:  # kvaser's way to say it
        raise ConfigError(
            f"bus {name!r}: can.interface {config.interface!r}: its driver library is not installed on this machine"
        ) from None
    except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
        raise refused_bus(config, name, " ".join(str(error).split()) or type(error).__name__) from None
    is_classic = opened.protocol is can.CanProtocol.CAN_20 and config.interface not in _SAYS_NOTHING_OF_FD
    if config.driver.fd and is_classic:
        opened.shutdown()
        raise ConfigError(
            f"bus {name!r}: can.interface {config.interface!r}, channel {config.channel!r}, carries no FD frames as it "
            "was opened; say fd = false, without data_bitrate_bit_per_s, or use another interface"
        )
    return opened


def refused_bus(config: CanConfig, name: str, why: str) -> ConfigError:
    """The error for a bus that can't be had, in its interface's own words."""
    return ConfigError(
        f"bus {name!r}: can.interface {config.interface!r}, channel {config.channel!r}: {why}; see [can] and "
        "[can.options] of the bus config"
    )


def to_frame(message: can.Message) -> Frame:
    """A message as a ``Frame``; the length that a remote frame asks for is the length of its ``data``."""
    return Frame(
        message.arbitration_id,
        bytes(message.dlc) if message.is_remote_frame else bytes(message.data),
        message.is_fd,
        message.bitrate_switch,
        message.is_remote_frame,
        message.is_extended_id,
        message.is_error_frame,
    )


def to_message(frame: Frame) -> can.Message:
    """A frame as python-can sends it."""
    return can.Message(
        arbitration_id=frame.can_id,
        data=None if frame.is_remote else frame.data,
        dlc=len(frame.data),
        is_fd=frame.is_fd,
        bitrate_switch=frame.bitrate_switch,
        is_remote_frame=frame.is_remote,
        is_extended_id=frame.is_extended,
        is_error_frame=frame.is_error,
        is_rx=False,
    )


class CanPort:
    """``runtime.Port`` on a python-can bus.

    ``refused`` counts frames that the bus did not take (queue full, bus-off): they are lost, and it is for the monitors
    to say when that is too much. ``refusal`` is a sentence on the latest of them, and ``complaint`` what stands in the
    way now. ``last_us`` is the time of the frame received last, by the stamp of its interface where that is a time of
    day, as python-can wants it, else when it was read; it never runs backwards.

    ``receive`` looks again and again for ``spin_us`` before it sleeps: an answer that comes within that time, as a
    sense frame does, is not delayed by a wake-up, some 50 us. It reckons by ``clock``, and leaves python-can's own
    ``recv`` alone: that follows the time of day, and waits for five seconds more where it is set back by five.
    """

    def __init__(self, bus: can.BusABC, clock: _Time, spin_us: int = 0) -> None:
        self._bus = bus
        self._clock = clock
        self._spin_us = spin_us
        has_own_recv = type(bus).recv is not can.BusABC.recv  # some that come from elsewhere, and wrappers
        self._read = bus.recv if has_own_recv else self._read_once
        self.sent = 0
        self.refused = 0
        self.refusal = ""
        self.last_us = 0
        self._refuses = self._is_bus_off = False

    def send(self, frame: Frame) -> bool:
        """Hand a frame to the bus; False if it was refused."""
        try:
            self._bus.send(to_message(frame))
        except (can.CanError, OSError, ValueError) as error:
            self.refused += 1
            self.refusal = _refusal(_reason(error))
            self._refuses = True
            return False
        self.sent += 1
        self._refuses = False
        return True

    def receive(self, deadline_us: int) -> Frame | None:
        """The next frame, or None once it is ``deadline_us``; one that is already there comes even after that, so
        whoever reads on and on looks at the clock in between.

        A bus that cannot be read any more is silent: the monitors find that out.
        """
        clock, read = self._clock, self._read
        sleep_us = min(deadline_us, clock.now_us + self._spin_us)
        try:
            while (message := read(0.0)) is None and clock.now_us < sleep_us:
                pass
            while message is None and (left_us := deadline_us - clock.now_us) > 0:
                message = read(left_us * 1e-6)
        except (can.CanError, OSError, ValueError):
            return None
        if message is None:
            return None
        if message.is_error_frame:
            self._is_bus_off = bool(message.arbitration_id & _ERROR_BUS_OFF)
        now_us = clock.now_us
        age_s = time.time() - message.timestamp
        stamp_us = now_us - round(age_s * 1e6) if 0 <= age_s < _STAMP_MAX_AGE_S else now_us
        self.last_us = max(self.last_us, stamp_us)
        return to_frame(message)

    def _read_once(self, timeout_s: float) -> can.Message | None:
        """A message that passes the filters; None also before the time is over, where one came that does not pass."""
        message, is_filtered = self._bus._recv_internal(timeout_s)
        return message if message is None or is_filtered or self._bus._matches_filters(message) else None

    @property
    def complaint(self) -> str:
        """``; the interface ...`` where it takes no frames, or says that it is off the bus; else empty."""
        return complaint_of(self._is_bus_off, self.refusal if self._refuses else "")

    def unsent(self) -> int:
        """0: python-can doesn't tell what still waits."""
        return 0

    def discard_unsent(self) -> None:
        """Empty the transmit queue of interfaces that can. The kernel's sockets can't,
        which python-can tells by NotImplementedError.
        """
        with suppress(can.CanError, OSError, NotImplementedError):
            self._bus.flush_tx_buffer()


def complaint_of(is_bus_off: bool, refusal: str) -> str:
    """``; the interface ...``: that it is off the bus, or why it takes no frames; empty where neither is so."""
    if is_bus_off:
        return f"; the interface is off the bus after too many errors (bus-off): {_BUS_OFF}"
    return f"; {refusal}" if refusal else ""


def refusal_of(number: int) -> str:
    """A sentence on a frame that was refused with an errno."""
    return _refusal(_with_remedy(os.strerror(number), number))


def _refusal(why: str) -> str:
    return f"the interface refuses frames ({why})"


def _reason(error: Exception) -> str:
    """Why a frame was not taken, in the interface's words, and what to do where that is known."""
    number = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return _with_remedy(" ".join(str(error).split()) or type(error).__name__, number)


def _with_remedy(words: str, number: object) -> str:
    remedy = _REMEDIES.get(number) if isinstance(number, int) else None
    return words if remedy is None else f"{words}; {remedy}"
