"""A CAN bus among the processes of one machine: python-can's ``can.Bus(interface="pkxyz-unix", channel=...)``.

Frames, FD included, are datagrams between Unix sockets in one folder, the channel: whoever opens the channel binds a
socket there, and a frame goes to all others, as long as they are the same user's (``unix_folder``). There is no wire
timing and no arbitration. A receiver that stands still finds some 256 frames when it goes on, as on a socket of the
kernel's CAN; what it missed beyond them is lost. The queue of a Unix socket is shorter (``net.unix.max_dgram_qlen``,
often 10: three ticks), so what does not fit waits with the sender, which hands it over whenever it sends or receives.

Unlike over other interfaces, ``timestamp`` is when the frame was sent, in seconds of the time of day.
"""

import errno
import os
import select
import socket
import struct
import time
from collections import deque
from itertools import count

import can

from hil.bus.unix_folder import (
    UnsafeFolderError,
    bind_privately,
    close_folder,
    folder_of,
    open_folder,
    remove_socket,
    socket_name,
    sockets_in,
)

# ns of CLOCK_MONOTONIC, which all processes of a machine share; identifier with the flags of linux/can.h; length;
# flags of the FD frame; then the data
_HEAD = struct.Struct("<qIBB")
_EXTENDED, _REMOTE, _ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
_BIT_RATE_SWITCH, _ERROR_STATE, _FD = 0x01, 0x02, 0x04
_LONGEST_PATH = 107  # sockaddr_un.sun_path less its closing zero
_GONE = {errno.ECONNREFUSED, errno.ENOENT, errno.ECONNRESET, errno.ENOTCONN}
_NO_PARTICIPANT = {errno.EPROTOTYPE, errno.EACCES, errno.EPERM}  # something else with a name like that
_JOIN_ATTEMPTS = 10
_WAITING_MOST = 256  # frames for one receiver
_RETRY_S = 0.5e-3  # how often a sender that waits for frames itself looks whether its own can be handed over
_LEAVE_S = 0.1  # for how long it does so before it leaves
_numbers = count(1)


class UnixBus(can.BusABC):
    """One participant. ``fd``: whether FD frames are carried; ``dropped`` counts frames that a full receiver lost.

    ``bitrate``, ``data_bitrate``, ``timing`` and ``single_handle`` are what python-can's tools give to every interface:
    taken, and without a meaning here.
    """

    def __init__(
        self,
        channel: str,
        can_filters: can.typechecking.CanFilters | None = None,
        fd: bool = True,
        receive_own_messages: bool = False,
        bitrate: int | None = None,
        data_bitrate: int | None = None,
        timing: can.BitTiming | can.BitTimingFd | None = None,
        single_handle: bool = True,
    ) -> None:
        self._folder = folder_of(str(channel))
        self._path = self._folder / socket_name(next(_numbers))
        self._fd = fd
        self._peers: list[str] = []
        self._listed_ns = -1
        self._waiting: dict[str, deque[bytes]] = {}
        self.dropped = 0
        self._own: list[can.Message] | None = [] if receive_own_messages else None
        self.channel = str(channel)
        self.channel_info = f"pkxyz-unix {channel}"
        if len(os.fsencode(self._path)) > _LONGEST_PATH:
            raise can.CanInitializationError(f"channel {channel!r}: the path of its folder is too long for a socket")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._join()
        except (OSError, UnsafeFolderError) as error:
            self._socket.close()
            reason = getattr(error, "strerror", None) or error
            raise can.CanInitializationError(f"channel {channel!r}: {reason}") from error
        super().__init__(channel, can_filters)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    def _join(self) -> None:
        """Into the folder; once more where the last of the others has just taken it away."""
        for attempt in range(_JOIN_ATTEMPTS):
            open_folder(self.channel)
            try:
                bind_privately(self._socket, self._path)
            except FileNotFoundError:
                if attempt == _JOIN_ATTEMPTS - 1:
                    raise
            else:
                return

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send to all others; ``timeout`` is not used, as nothing here waits.

        Raises CanOperationError for an FD frame where the bus was opened without, or after ``shutdown``.
        """
        if msg.is_fd and not self._fd:
            raise can.CanOperationError(f"{self.channel_info}: opened without fd, cannot send an FD frame")
        if self._waiting:
            self._hand_over()
        others = self._others()
        datagram = _pack(msg)  # stamped when it is on the bus
        for peer in others:
            waiting = self._waiting.get(peer)
            if waiting is None and self._reaches(peer, datagram):
                continue
            waiting = self._waiting.setdefault(peer, deque())
            if len(waiting) < _WAITING_MOST:
                waiting.append(datagram)
            else:
                self.dropped += 1
        if self._own is not None:
            own = _unpack(datagram, self.channel)
            own.is_rx = False
            self._own.append(own)

    def _reaches(self, peer: str, datagram: bytes) -> bool:
        """Send to one other; False if its queue is full. One that is gone is forgotten, which is as good."""
        try:
            self._socket.sendto(datagram, peer)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno in _GONE:
                self._forget(peer)
            elif error.errno not in _NO_PARTICIPANT:
                raise can.CanOperationError(f"{self.channel_info}: {error.strerror}", error.errno) from error
        return True

    def _hand_over(self) -> None:
        """What waits, as far as there is room for it, in its order."""
        for peer, waiting in list(self._waiting.items()):
            while waiting and self._reaches(peer, waiting[0]):
                waiting.popleft()
            if not waiting:
                self._waiting.pop(peer, None)

    def flush_tx_buffer(self) -> None:
        """Forget what waits."""
        self._waiting.clear()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self._own:
            return self._own.pop(0), False
        receiver = self._socket
        if self._waiting:
            self._hand_over()
            timeout = _RETRY_S if timeout is None else min(timeout, _RETRY_S)  # python-can asks again until its time
        for attempt in range(2):
            try:
                message = _unpack(receiver.recv(128), self.channel)
            except BlockingIOError:
                if attempt == 1 or timeout == 0.0:
                    return None, False
                try:
                    select.select((receiver,), (), (), timeout)
                except (OSError, ValueError) as error:
                    raise can.CanOperationError(f"{self.channel_info}: {error}") from error
            except (struct.error, ValueError):
                continue  # not one of ours: whoever can write into the folder can send anything
            except OSError as error:
                raise can.CanOperationError(f"{self.channel_info}: {error.strerror}", error.errno) from error
            else:
                if message.is_fd and not self._fd:
                    continue  # a classic controller never sees one
                return message, False
        return None, False

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the channel, once what waits was handed over or nobody takes it."""
        if not self._is_shutdown:
            end_s = time.monotonic() + _LEAVE_S
            while self._waiting and time.monotonic() < end_s:
                time.sleep(_RETRY_S)
                self._hand_over()
            super().shutdown()
            self._socket.close()
            remove_socket(self._path)
            close_folder(self.channel)

    @property
    def others(self) -> int:
        """How many sockets of other participants there are; one that was killed counts until somebody sends to it."""
        return len(self._others())

    def _others(self) -> list[str]:
        """Sockets of the other participants; the folder is listed again when it has changed."""
        try:
            changed_ns = os.stat(self._folder).st_mtime_ns
            # A folder's time is that of the kernel's last tick, up to 10 ms coarse: what is younger may change unseen.
            if changed_ns != self._listed_ns:
                settled = time.time_ns() - changed_ns > 20_000_000
                self._listed_ns = changed_ns if settled else -1
                mine = str(self._path)
                self._peers = [path for path in sockets_in(self._folder) if path != mine]
        except FileNotFoundError:
            self._peers = []
        return self._peers

    def _forget(self, peer: str) -> None:
        """Take away what a killed process left behind."""
        remove_socket(peer)
        self._peers = [other for other in self._peers if other != peer]
        self._waiting.pop(peer, None)


def _pack(msg: can.Message) -> bytes:
    can_id = msg.arbitration_id
    if msg.is_extended_id:
        can_id |= _EXTENDED
    if msg.is_remote_frame:
        can_id |= _REMOTE
    if msg.is_error_frame:
        can_id |= _ERROR
    flags = (
        (_FD if msg.is_fd else 0)
        | (_BIT_RATE_SWITCH if msg.bitrate_switch else 0)
        | (_ERROR_STATE if msg.error_state_indicator else 0)
    )
    return _HEAD.pack(time.monotonic_ns(), can_id, msg.dlc, flags) + (b"" if msg.is_remote_frame else bytes(msg.data))


def _unpack(datagram: bytes, channel: str) -> can.Message:
    """Raises struct.error or ValueError for what is not a frame."""
    sent_ns, can_id, length, flags = _HEAD.unpack_from(datagram)
    data = datagram[_HEAD.size :]
    is_remote, is_fd = bool(can_id & _REMOTE), bool(flags & _FD)
    if length > (64 if is_fd else 8) or (len(data) != length and not is_remote):
        raise ValueError("not a frame")
    return can.Message(
        timestamp=time.time() - (time.monotonic_ns() - sent_ns) * 1e-9,
        arbitration_id=can_id & (0x1FFF_FFFF if can_id & _EXTENDED else 0x7FF),
        is_extended_id=bool(can_id & _EXTENDED),
        is_remote_frame=is_remote,
        is_error_frame=bool(can_id & _ERROR),
        channel=channel,
        dlc=length,
        data=None if is_remote else data,
        is_fd=is_fd,
        bitrate_switch=bool(flags & _BIT_RATE_SWITCH),
        error_state_indicator=bool(flags & _ERROR_STATE),
    )
