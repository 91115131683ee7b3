"""Frames for the gate's tests, made without any of our codecs: the CRC bit by bit, the layouts by hand."""

import struct

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Mode

NODE = 10
DRIVE_ID = 0x30A
CONFIG = GateConfig(count_max=30000, count_slew_max=1000, period_us=200)


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
