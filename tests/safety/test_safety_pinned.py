"""What mutation testing found that no law noticed: numbers that are contracts by themselves, written down again."""

import dataclasses
import struct

import pytest
from loop_rig import monitor_limits

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.safety.gate import GateConfig
from pkxyz_ctrl.safety.gate_rules import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.monitors import NodeEvent, SenseStatus
from pkxyz_ctrl.safety.sdo_rules import write_refusal
from pkxyz_ctrl.safety.trips import LANDS, Trip

LIMITS = GateConfig(count_max=30000, count_slew_max=500, period_us=200).record[0]["writes"]

# Bits of a recording that somebody may read in years.
TRIPS = [
    "SENSE_STALE",
    "SENSE_SEQUENCE",
    "SENSE_CRC",
    "SENSE_LENGTH",
    "SENSE_RANGE_1",
    "SENSE_RANGE_2",
    "SENSE_RANGE_3",
    "SENSE_FROZEN_1",
    "SENSE_FROZEN_2",
    "SENSE_FROZEN_3",
    "INNOVATION_X",
    "INNOVATION_Y",
    "INNOVATION_Z",
    "SATURATION",
    "SLEW",
    "OVERRUN",
    "SOLVER",
    "NOT_FINITE",
    "HEARTBEAT_LOST",
    "NODE_NOT_OPERATIONAL",
    "NODE_REBOOTED",
    "NODE_EMERGENCY",
    "GATE_BLOCKED",
    "OPERATOR",
    "COMB_MISFIT_1",
    "COMB_MISFIT_2",
    "COMB_MISFIT_3",
    "COMB_FORCE_1",
    "COMB_FORCE_2",
    "COMB_FORCE_3",
    "FOREIGN_FRAME",
    "SAFETY_OBJECTS",
]


def test_trip_bits() -> None:
    assert {name: trip.value for name, trip in Trip.__members__.items()} == {
        name: 1 << place for place, name in enumerate(TRIPS)
    }


def test_after_which_trips_the_stage_is_led_down() -> None:
    """After all others the combs go to 0 V at once."""
    assert {trip.name for trip in Trip if trip in LANDS} == {"SATURATION", "OVERRUN", "SOLVER", "OPERATOR"}


def test_bits_of_what_was_wrong_with_a_frame_and_a_node() -> None:
    """The driver raises them by number."""
    sense = ["MISSING", "COUNTER", "CRC", "LENGTH", "DUPLICATE", "IMPLAUSIBLE"]
    assert {name: bit.value for name, bit in SenseStatus.__members__.items()} == {
        n: 1 << k for k, n in enumerate(sense)
    }
    node = ["HEARTBEAT_LOST", "NOT_OPERATIONAL", "REBOOTED", "EMERGENCY", "FOREIGN_FRAME", "SAFETY_OBJECTS"]
    assert {name: bit.value for name, bit in NodeEvent.__members__.items()} == {n: 1 << k for k, n in enumerate(node)}


# What may be written to the amplifier (node 10, controller 127, at most 1000 ms and 500 counts): objects, sub-indices,
# bytes, a value that is permitted, and values that are not. docs/understand/safety.md, CiA 301 and 401.
OFF = 1 << 31
WRITES = (
    (0x1005, 0x1005, 0, 0, 4, 0x80, (0x81, 0x40000080, 0)),
    (0x1016, 0x1016, 1, 1, 4, 127 << 16 | 1000, (127 << 16, 127 << 16 | 1001, 126 << 16 | 50, 50)),
    (0x1017, 0x1017, 0, 0, 2, 1, (0,)),
    (0x1019, 0x1019, 0, 0, 1, 240, (0, 239, 241)),
    (0x1029, 0x1029, 1, 1, 1, 2, (1, 3)),
    (0x1400, 0x15FF, 1, 1, 4, OFF, (0x20A, 0x40A)),
    (0x1401, 0x1401, 2, 2, 1, 1, (0, 2, 255)),
    (0x1600, 0x17FF, 0, 0, 1, 5, (6, 255)),
    (0x1600, 0x17FF, 1, 64, 4, 0x64110110, (0x64440120, 0x20100008, 0x10160120, 0x64110410, 0x64110108)),
    (0x1800, 0x19FF, 1, 1, 4, 0x28A, (0x28B, 0x30A, 0x0A)),
    (0x1800, 0x19FF, 2, 2, 1, 1, ()),
    (0x1800, 0x19FF, 3, 3, 2, 0, ()),
    (0x1800, 0x19FF, 5, 5, 2, 0, ()),
    (0x1A00, 0x1BFF, 0, 0, 1, 5, ()),
    (0x1A00, 0x1BFF, 1, 64, 4, 0x64010110, ()),
    (0x2010, 0x2010, 0, 0, 1, 1, (0,)),
    (0x2011, 0x2011, 0, 0, 2, 500, (0, 501, 0xFFFF)),
    (0x2012, 0x2012, 0, 0, 2, 1000, (0, 1001, 0xFFFF)),
    (0x6443, 0x6443, 1, 3, 1, 1, (0, 2)),
    (0x6444, 0x6444, 1, 3, 4, 0, (1, 0xFFFFFFFF)),
)
COMMAND = {1: 0x2F, 2: 0x2B, 3: 0x27, 4: 0x23}


def refused(index: int, subindex: int, size: int, value: int) -> bool:
    data = struct.pack("<BHBI", COMMAND[size], index, subindex, value)
    return write_refusal(LIMITS, int.from_bytes(data, "little", signed=True)) != 0


def test_writes_at_every_corner_and_one_step_beyond() -> None:
    indices = sorted({row[place] + step for row in WRITES for place, step in ((0, -1), (0, 0), (1, 0), (1, 1))})
    subindices = sorted(
        {row[place] + step for row in WRITES for place, step in ((2, -1), (2, 0), (3, 0), (3, 1))} - {-1}
    )
    permitted = 0
    for index in indices:
        for subindex in subindices:
            rows = [row for row in WRITES if row[0] <= index <= row[1] and row[2] <= subindex <= row[3]]
            for size in COMMAND:
                expected = bool(rows) and rows[0][4] == size
                # What is refused for its place must be so with the values that a neighbour permits.
                values = {rows[0][5]} if expected else {0, *(row[5] for row in WRITES if abs(row[0] - index) <= 1)}
                for value in values:
                    if value >> 8 * size == 0:
                        assert refused(index, subindex, size, value) is not expected, (
                            hex(index),
                            subindex,
                            size,
                            value,
                        )
                permitted += expected
    assert permitted > 50


@pytest.mark.parametrize("row", WRITES, ids=lambda row: f"{row[0]:04X}-{row[2]}")
def test_values_that_are_not_permitted(row: tuple[int, int, int, int, int, int, tuple[int, ...]]) -> None:
    first, last, sub_first, sub_last, size, value, wrong = row
    for index in (first, last):
        for subindex in (sub_first, sub_last):
            assert not refused(index, subindex, size, value)
            for bad in wrong:
                assert refused(index, subindex, size, bad)


def test_values_with_more_than_one_permitted() -> None:
    assert not refused(0x1029, 1, 1, 0)
    assert not refused(0x1016, 1, 4, 127 << 16 | 1)
    assert not refused(0x2011, 0, 2, 1)
    assert not refused(0x2012, 0, 2, 1)
    for entry in (0, 0x64110210, 0x64110310, 0x20000108, 0x20000208):
        assert not refused(0x1601, 1, 4, entry)
    for number in range(6):
        assert not refused(0x1601, 0, 1, number)
    for cob_id in (0x30A, 0x4000030A, OFF | 0x30A, OFF):
        assert not refused(0x1401, 1, 4, cob_id)
    for index in (0x1400, 0x1402):
        assert refused(index, 1, 4, 0x30A)  # only the drive PDO may have the drive PDO's identifier
    for cob_id in (0x18A, 0x28A, 0x38A, 0x48A, 0x4000028A, OFF | 0x7FF):
        assert not refused(0x1801, 1, 4, cob_id)


@pytest.mark.parametrize(("index", "subindex", "size"), [(0x1A01, 0, 1), (0x1801, 3, 2)])
def test_nothing_may_stand_behind_the_value(index: int, subindex: int, size: int) -> None:
    """Of objects that may hold anything: whatever is refused, is so for the bytes behind."""
    for bit in range(32):
        data = struct.pack("<BHBI", COMMAND[size], index, subindex, 1 << bit)
        assert (write_refusal(LIMITS, int.from_bytes(data, "little", signed=True)) != 0) == (bit >= 8 * size)


GATE_RANGES = {
    "count_max": (0, 32767),
    "count_slew_max": (1, 32767),
    "period_us": (2, 1_000_000),
    "node_id": (1, 127),
    "controller_node_id": (1, 127),
    "heartbeat_timeout_max_ms": (1, 65535),
    "spacing_min_us": (0, 200),
}


@pytest.mark.parametrize("name", GATE_RANGES)
def test_gate_config_takes_its_ranges_and_nothing_beyond(name: str) -> None:
    low, high = GATE_RANGES[name]
    good = GateConfig(count_max=30000, count_slew_max=500, period_us=200, node_id=10, controller_node_id=20)
    for value in (low, high):
        assert getattr(dataclasses.replace(good, **{name: value}), name) == value
    for value in (low - 1, high + 1):
        with pytest.raises(ValueError, match=name):
            dataclasses.replace(good, **{name: value})


def test_gate_config_defaults_are_those_of_the_wire() -> None:
    config = GateConfig(count_max=30000, count_slew_max=500, period_us=200)
    assert dataclasses.asdict(config) == {
        "count_max": 30000, "count_slew_max": 500, "period_us": 200, "node_id": 10, "controller_node_id": 127,
        "protection": True, "fd": True, "spacing_min_us": None, "heartbeat_timeout_max_ms": 1000,
        "drive_pdo": 2, "drive_channels": (1, 2, 3), "digital_outputs": False,
    }  # fmt: skip


KINDS = "SYNC HEARTBEAT DRIVE_ZERO DRIVE SDO_READ SDO_WRITE NMT_START NMT_STOP NMT_PRE_OPERATIONAL NMT_RESET OUTPUTS"
ALWAYS_KINDS = {"SYNC", "HEARTBEAT", "DRIVE_ZERO", "NMT_STOP", "NMT_PRE_OPERATIONAL"}
CONFIGURING = {"SDO_READ", "SDO_WRITE", "NMT_START", "NMT_RESET"}
MODE_KINDS = {
    Mode.BOOT: CONFIGURING,
    Mode.PRE_OPERATIONAL: CONFIGURING,
    Mode.IDLE: {"SDO_READ", "NMT_RESET", "OUTPUTS"},
    Mode.HOMING: {"SDO_READ", "OUTPUTS"},
    Mode.ENABLED: {"SDO_READ", "DRIVE", "OUTPUTS"},
    Mode.TRACKING: {"SDO_READ", "DRIVE", "OUTPUTS"},
    Mode.FAULT: {"SDO_READ", "NMT_RESET"},
    Mode.LANDING: {"SDO_READ", "DRIVE", "OUTPUTS"},
}


def test_kinds_of_frames_are_one_bit_each() -> None:
    """Two kinds on one bit would permit each other."""
    names = {name: kind.value for name, kind in FrameKind.__members__.items()}
    assert names == {name: 1 << place for place, name in enumerate(KINDS.split(" "))}


@pytest.mark.parametrize("mode", Mode)
def test_what_each_mode_permits(mode: Mode) -> None:
    assert {kind.name for kind in FrameKind if kind & PERMITTED[mode]} == ALWAYS_KINDS | MODE_KINDS[mode]


def test_identifiers_of_a_codec_have_eleven_bits() -> None:
    for cob_id in (0, 0x7FF):
        assert ProcessCodec(cob_id, True).decode(ProcessCodec(cob_id, True).encode((1, -2, 3), 4))[4]
    for cob_id in (-1, 0x800):
        with pytest.raises(ValueError, match="11 bits"):
            ProcessCodec(cob_id, True)


def limit_of(bus: str) -> float:
    """What a change of unexplained force may be besides, on a bus."""
    return float(load_scenario("raster", controller="lqg", bus=bus).setup().law["limits"]["force_change_max_n"][0])


def test_limits_of_the_monitors() -> None:
    """They decide when 200 V go off, so nobody changes one by a slip; why they are what they are is told there."""
    assert monitor_limits().shape == (1,)
    limits = monitor_limits()[0]
    counts = {name: int(limits[name]) for name in limits.dtype.names if name.endswith(("_count", "_ticks"))}
    assert counts == {
        "stale_count": 5, "sequence_count": 8, "crc_count": 5, "length_count": 5, "range_count": 3,
        "frozen_count": 50, "innovation_count": 5, "saturation_count": 250, "slew_count": 1, "overrun_count": 10,
        "solver_count": 5, "frame_leak_ticks": 200, "overrun_leak_ticks": 500, "residual_count": 3,
        "unexplained_force_count": 5,
    }  # fmt: skip
    assert limits["safe_cycles"] == 10
    assert (limits["residual_max_m"], limits["unexplained_force_max_n"]) == (0.7e-6, 0.8e-3)
    assert (limits["force_change_max_n"], limits["force_change_share"]) == (32e-6, 0.47)
    assert {name: limit_of(name) for name in ("local_20k", "unix_5k", "unix_2k", "unix_1k")} == {
        "local_20k": 32e-6, "unix_5k": 32e-6, "unix_2k": pytest.approx(40e-6), "unix_1k": pytest.approx(40e-6),
    }  # fmt: skip
    assert limits["innovation_share_m_per_n"] == 1.5e-3
    assert limits["saturation_slack_n"] == 50e-9
    assert limits["force_forget_share"] == pytest.approx(200e-6 / 2e-3, rel=1e-12)
    assert limits["force_trend_share"] == pytest.approx(200e-6 / 0.03, rel=1e-12)
    assert (limits["stroke_min_m"], limits["stroke_max_m"]) == (-2e-6, 27e-6)
    assert 19.99 < limits["voltage_step_max_v"] < 20.0  # 100 V/ms at 5 kHz, to whole counts and half of one
    assert (limits["sense_count_min"], limits["sense_count_max"]) == (-32768, 32767)
    assert list(limits["innovation_max_m"]) == [0.5e-6] * 3


def test_a_codec_tells_the_length_of_its_payload() -> None:
    assert (ProcessCodec(0x30A, True).length, ProcessCodec(0x30A, False).length) == (8, 6)
