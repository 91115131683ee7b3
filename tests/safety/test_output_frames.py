"""The gate and RPDO 1: it may carry five trigger bits, once between two SYNCs, while the loop works; nothing else."""

import dataclasses

import pytest
from gate_frames import CONFIG, drive, sdo_write, sync

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety import gate_rules
from pkxyz_ctrl.safety.gate import TransmitGate
from pkxyz_ctrl.safety.modes import Mode

WITH = dataclasses.replace(CONFIG, digital_outputs=True)
AT_WORK = {Mode.IDLE, Mode.HOMING, Mode.ENABLED, Mode.TRACKING, Mode.LANDING}


def outputs(bits: int, can_id: int = 0x20A) -> Frame:
    return Frame(can_id, bytes([bits]), True, True)


def gate(config=WITH) -> TransmitGate:
    made = TransmitGate(config)
    assert made.check(sync(), Mode.IDLE, 0) is None
    return made


@pytest.mark.parametrize("mode", Mode)
def test_in_which_modes(mode: Mode) -> None:
    told = gate().check(outputs(1), mode, 10)
    assert (told is None) == (mode in AT_WORK)
    if told:
        assert "OUTPUTS is not permitted now" in told


@pytest.mark.parametrize("bits", range(256))
def test_only_bits_that_mean_something(bits: int) -> None:
    told = gate().check(outputs(bits), Mode.TRACKING, 10)
    assert (told is None) == (bits <= 0x1F), told


def test_one_between_two_syncs() -> None:
    made = gate()
    assert made.check(outputs(1), Mode.TRACKING, 10) is None
    assert "a second frame with digital outputs" in (made.check(outputs(0), Mode.TRACKING, 20) or "")
    fresh = TransmitGate(WITH)
    assert "no SYNC went out" in (fresh.check(outputs(1), Mode.TRACKING, 20) or "")


def test_a_gate_that_has_forgotten_waits_for_a_sync() -> None:
    made = gate()
    gate_rules.forget(made.memory)
    assert "no SYNC went out" in (made.check(outputs(1), Mode.TRACKING, 10) or "")


@pytest.mark.parametrize("data", [b"", b"\1\0", bytes(8)])
def test_of_its_length(data: bytes) -> None:
    assert "instead of 1" in (gate().check(Frame(0x20A, data, True, True), Mode.TRACKING, 10) or "")


def test_nothing_after_a_blocked_frame() -> None:
    made = gate()
    assert made.check(drive(5, 0, 0, 0), Mode.FAULT, 10)
    assert "latched" in (made.check(outputs(0), Mode.TRACKING, 10) or "")
    made.clear()
    assert made.check(outputs(0), Mode.TRACKING, 10) is None


def test_without_outputs_the_identifier_is_foreign() -> None:
    assert "not in the list" in (gate(CONFIG).check(outputs(1), Mode.TRACKING, 10) or "")
    assert "not in the list" in (gate().check(outputs(1, 0x20B), Mode.TRACKING, 10) or "")


@pytest.mark.parametrize(
    ("index", "subindex", "size", "permitted", "refused"),
    [
        (0x1400, 1, 4, [0x20A, 0x8000020A, 0x80000000], [0x30A, 0x20B, 0x2000020A]),
        (0x1400, 2, 1, [1], [0, 2, 255]),
        (0x1600, 1, 4, [0, 0x62000108], [0x64110110, 0x20000108, 0x62000110, 0x64440120, 0x10160120]),
        (0x1401, 1, 4, [0x30A], [0x20A]),
        (0x1601, 1, 4, [0x64110110], [0x62000108]),
        (0x1402, 1, 4, [0x80000000], [0x20A]),
    ],
)
def test_rpdo_1_never_maps_a_voltage(index, subindex, size, permitted, refused) -> None:
    """Its frames pass the gate without a look at voltages, so that none may be in them."""
    for value in permitted:
        assert gate().check(sdo_write(index, subindex, value, size), Mode.BOOT, 10) is None, hex(value)
    for value in refused:
        assert gate().check(sdo_write(index, subindex, value, size), Mode.BOOT, 10), hex(value)
