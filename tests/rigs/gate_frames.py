"""Frames for the gate's tests, made without any of our codecs: the CRC bit by bit, the layouts by hand."""

import struct

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Mode

NODE = 10
DRIVE_ID = 0x30A
CONFIG = GateConfig(count_max=30000, count_slew_max=1000, period_us=200)

# index, sub-index, size, permitted values, refused values
WRITES = [
    (0x1005, 0, 4, [0x80], [0x81, 0x40000080, 0]),
    (0x1016, 1, 4, [0x7F0001, 0x7F03E8], [0x7F0000, 0x7F03E9, 0x7E0032, 0x0A0032, 0]),
    (0x1017, 0, 2, [1, 0xFFFF], [0]),
    (0x1019, 0, 1, [240], [0, 239, 241]),
    (0x1029, 1, 1, [0, 2], [1, 3, 255]),
    (0x1400, 1, 4, [0x8000020A, 0x80000000], [0x20A, 0x30A]),
    (0x1401, 1, 4, [0x30A, 0x8000030A, 0x4000030A], [0x30B, 0x080, 0x2000030A]),
    (0x1401, 2, 1, [1], [0, 2, 240, 254, 255]),
    (0x1601, 0, 1, [0, 5], [6, 255]),
    (0x1601, 1, 4, [0, 0x64110110, 0x20000208], [0x64440120, 0x20100008, 0x10160120, 0x64110120]),
    (0x1801, 1, 4, [0x28A, 0x4000028A, 0x8000028A], [0x080, 0x30A, 0x28B, 0x000, 0x77F]),
    (0x1801, 2, 1, [0, 1, 255], []),
    (0x1801, 3, 2, [0, 1000], []),
    (0x1801, 5, 2, [0, 1000], []),
    (0x1A01, 0, 1, [0, 5], []),
    (0x1A01, 1, 4, [0x64010110], []),
    (0x2010, 0, 1, [1, 5, 255], [0]),
    (0x2011, 0, 2, [1, 999, 1000], [0, 1001, 0xFFFF]),
    (0x2012, 0, 2, [1, 20, 1000], [0, 1001, 0xFFFF]),
    *((0x6443, comb, 1, [1], [0, 2, 255]) for comb in (1, 2, 3)),
    *((0x6444, comb, 4, [0], [1, 0x7FFFFFFF, 0xFFFFFFFF]) for comb in (1, 2, 3)),
]


def crc8h2f(data: bytes) -> int:
    """AUTOSAR CRC8H2F by shifting: polynomial 0x2F, initial value and final xor 0xFF."""
    register = 0xFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register << 1) ^ (0x12F if register & 0x80 else 0)
    return register ^ 0xFF


def drive(a: int, b: int, c: int, counter: int, can_id: int = DRIVE_ID) -> Frame:
    payload = struct.pack("<hhhB", a, b, c, counter & 0xFF)
    return Frame(can_id, payload + bytes([crc8h2f(struct.pack("<H", can_id) + payload)]), True, True)


def sync(counter: int = 1) -> Frame:
    return Frame(0x080, bytes([counter]), True, True)


def sdo_write(index: int, subindex: int, value: int, size: int) -> Frame:
    command = {1: 0x2F, 2: 0x2B, 3: 0x27, 4: 0x23}[size]
    return Frame(0x60A, struct.pack("<BHBI", command, index, subindex, value))


def sdo_read(index: int, subindex: int) -> Frame:
    return Frame(0x60A, struct.pack("<BHBI", 0x40, index, subindex, 0))


def nmt(command: int, node: int = NODE) -> Frame:
    return Frame(0x000, bytes([command, node]))


def holding(counts: tuple[int, int, int], config: GateConfig = CONFIG) -> TransmitGate:
    """A gate whose last drive frame held ``counts`` with alive counter 255 at 0 us, followed by a SYNC.

    The way there is walked in permitted steps.
    """
    gate = TransmitGate(config)
    steps = max(-(-count // config.count_slew_max) for count in counts)
    for k in range(steps + 1):
        t_us = (k - steps) * config.period_us
        a, b, c = (min(count, k * config.count_slew_max) for count in counts)
        assert gate.check(drive(a, b, c, 255 - steps + k), Mode.TRACKING, t_us) is None
        assert gate.check(sync(), Mode.TRACKING, t_us) is None
    return gate
