"""The amplifier driver against canopen's LocalNode: another implementation answers, no threads, no machine clock.

canopen's node does no NMT gating, no boot-up after a reset and no SYNC-driven PDO (so says its source), therefore this
file and its bench send the boot-up, the heartbeats and the sense PDOs for it, packed by canopen's own PDO maps.
"""

from copy import copy

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen_bench import FRAME_US, Bench

from pkxyz_ctrl.can.driver import NODE_REBOOTED
from pkxyz_ctrl.can.driver_config import DriverConfig, ProvenModule
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.process_pdo import crc8
from pkxyz_ctrl.can.sense_input import SENSE_COUNTER, SENSE_MISSING
from pkxyz_ctrl.can.startup import settings


@pytest.mark.parametrize("protection", [True, False])
def test_start_up_configures_canopens_node(protection):
    bench = Bench(DriverConfig(protection=protection))
    bench.start()
    assert (bench.driver.state, bench.driver.failure) == (DriverState.OPERATIONAL, "")
    assert bench.node.nmt.state == "OPERATIONAL"
    sdo = bench.node.sdo
    assert [sdo[0x1401][1].raw, sdo[0x1801][1].raw] == [0x30A, 0x4000028A]
    assert [sdo[0x1401][2].raw, sdo[0x1801][2].raw] == [1, 1]
    assert [sdo[0x6443][comb].raw for comb in (1, 2, 3)] == [1, 1, 1]
    assert [sdo[0x6444][comb].raw for comb in (1, 2, 3)] == [0, 0, 0]
    assert (sdo[0x1016][1].raw, sdo[0x1017].raw, sdo[0x1019].raw) == (127 << 16 | 50, 20, 240)
    length = 8 if protection else 6
    for pdo in (bench.node.rpdo[2], bench.node.tpdo[2]):
        pdo.read(from_od=False)
        assert (pdo.enabled, pdo.trans_type, len(pdo.data)) == (True, 1, length)
    assert bench.bus.tasks[-1].period_us == 20_000


def test_a_node_that_only_stores_what_it_should_do_without_us_is_not_enabled():
    bench = Bench(DriverConfig(), consumes=False)
    bench.start()
    assert bench.node.sdo[0x1016][1].raw == 127 << 16 | 50
    assert bench.driver.state is DriverState.FAILED
    assert "did not notice that our heartbeat ended: 120 ms later its heartbeat says op" in bench.driver.failure
    assert bench.node.nmt.state == "PRE-OPERATIONAL"


def test_drive_and_sense_through_canopens_pdo_maps():
    bench = Bench(DriverConfig())
    bench.start()
    drive, sense = bench.node.rpdo[2], bench.node.tpdo[2]
    drive.read()
    sense.read()
    for tick in range(300):
        bench.driver.sync(bench.t_us)
        counts = (3 * tick, 32767 - tick, 17)
        sent = bench.driver.drive(counts, bench.t_us)
        drive.on_message(sent.can_id, bytearray(sent.data), bench.t_us * 1e-6)
        assert tuple(variable.raw for variable in drive)[:4] == (*counts, tick & 0xFF)
        assert drive[4].raw == crc8(b"\x0a\x03" + sent.data[:7])
        for variable, value in zip(sense, (-tick, tick, -32768, tick & 0xFF, 0), strict=True):
            variable.raw = value
        sense[4].raw = crc8(b"\x8a\x02" + bytes(sense.data[:7]))
        bench.driver.receive(Frame(sense.cob_id, bytes(sense.data)), bench.t_us)
        assert bench.driver.sense.take() == (-tick, tick, -32768, 0)
    bench.driver.sync(bench.t_us)
    bench.driver.receive(Frame(sense.cob_id, bytes(sense.data)), bench.t_us)  # the same again
    assert bench.driver.sense.take() == (-299, 299, -32768, SENSE_MISSING | SENSE_COUNTER)


def test_canopens_emergency_producer_is_understood():
    bench = Bench(DriverConfig())
    bench.start()
    bench.node.emcy.send(0x4210, register=0x09, data=b"hot")
    for frame in bench.from_node():
        bench.driver.receive(frame, bench.t_us)
    assert bench.driver.emergencies[-1].text == (
        "EMCY 0x4210: device temperature (error register 0x09, data 68 6f 74 00 00)"
    )


def test_wrong_identity():
    bench = Bench(DriverConfig(product_code=4))
    bench.start()
    assert bench.driver.state is DriverState.FAILED
    assert "0x1018:02 (product code) is 0x00000003, expected 0x00000004; check that this is" in bench.driver.failure
    assert bench.node.nmt.state == "PRE-OPERATIONAL"


@pytest.mark.parametrize(
    ("index", "told", "remedy"),
    [
        (0x2000, "0x06020000", "set protection = false in the bus config"),
        (0x2011, "no 0x2011 (largest step", "makes two in one where a frame is lost"),
        (
            0x6444,
            "no 0x6444 (error value of comb 1: 0 V), and no report",
            "give its report to `pkxyz run --report`",
        ),
        (0x1016, "no 0x1016 (consumer of our heartbeat), and nothing else takes the combs to 0 V", "must not be used"),
        (0x1401, "no 0x1401", "in the PDOs and channels of the bus config"),
    ],
)
def test_an_object_that_canopens_node_lacks(index, told, remedy):
    bench = Bench(DriverConfig())
    del bench.node.object_dictionary[index]
    if index == 0x2000:  # canopen stores any mapping; a device with PDO checks refuses it as it refuses the object
        bench.node.object_dictionary[0x1601][0].default = 3
        bench.node.add_write_callback(refuse_unknown_mapping(bench.node.object_dictionary))
    bench.start()
    assert bench.driver.state is DriverState.FAILED
    assert remedy in bench.driver.failure
    assert told in bench.driver.failure


def refuse_unknown_mapping(dictionary):
    def on_write(index, subindex, od, data):
        mapped_index = int.from_bytes(data[2:4], "little")
        if index in (0x1601, 0x1A01) and subindex and mapped_index not in dictionary:
            raise canopen.SdoAbortedError(0x06020000)

    return on_write


def test_a_node_that_does_not_boot():
    bench = Bench(DriverConfig(boot_timeout_us=5_000, sdo_timeout_us=1_000), boots=False)
    bench.node.network.subscribers.clear()  # nobody is there
    bench.start()
    assert bench.driver.state is DriverState.FAILED
    assert "sent no boot-up message 0x70A within 5 ms of NMT reset, 3 times" in bench.driver.failure
    assert 18_000 <= bench.t_us <= 20_000


@pytest.mark.parametrize(("index", "lost"), [(0x1019, "no 0x1019"), (0x1029, "no 0x1029"), (0x1005, "")])
def test_what_a_node_may_lack_is_said(index, lost):
    bench = Bench(DriverConfig())
    del bench.node.object_dictionary[index]
    bench.start()
    assert (bench.driver.state, bench.driver.failure) == (DriverState.OPERATIONAL, "")
    assert [line[: len(lost)] for line in bench.driver.lost] == ([lost] if lost else [])
    assert bench.driver.sync(0).data == (b"" if index == 0x1019 else b"\1")
    assert bench.driver.sync(0).data == (b"" if index == 0x1019 else b"\2")


def test_a_boot_up_that_was_missed_is_no_end():
    bench = Bench(DriverConfig(boot_timeout_us=5_000))
    heard = bench.from_node
    bench.from_node = lambda: [f for f in heard() if (f.can_id, f.data) != (0x70A, b"\0")]
    bench.start()
    assert (bench.driver.state, bench.driver.failure) == (DriverState.OPERATIONAL, "")
    assert "sent no boot-up message 0x70A within 5 ms of NMT reset, 3 times: that it answers" in bench.driver.lost[0]


@pytest.mark.parametrize("protection", [True, False])
def test_what_stands_is_not_written(protection):
    """A mapping and identifiers that can't be changed are right as they are; only what differs is written."""
    bench = Bench(DriverConfig(protection=protection))
    entries = bench.node.object_dictionary
    written = []
    if not protection:
        for index in (0x1601, 0x1A01):
            entries[index][0].default = 3
    for index in (0x1401, 0x1601, 0x1801, 0x1A01):
        for variable in entries[index].values():
            variable.access_type = "const"
    bench.node.add_write_callback(lambda index, subindex, od, data: written.append((index, subindex)))
    bench.start()
    assert (bench.driver.state, bench.driver.failure) == (DriverState.OPERATIONAL, "")
    assert written == [(0x1016, 1), (0x1017, 0)]


@pytest.mark.parametrize(("index", "subindex"), [(0x2010, 0), (0x2011, 0), (0x2012, 0), (0x1016, 1), (0x6443, 1)])
def test_one_damaged_answer_is_not_taken_for_a_value_that_stands(index, subindex):
    """The node holds something else, and the first answer says the right thing: it is read once more."""
    config = DriverConfig()
    setting = next(s for s in settings(config) if s.key == (index, subindex))
    bench = Bench(config)
    entry = bench.node.object_dictionary[index]
    (entry if isinstance(entry, ODVariable) else entry[subindex]).default = setting.value ^ 1
    shipped, lies = bench.driver.receive, []

    def receive(frame: Frame, t_us: int) -> tuple[Frame, ...]:
        if frame.can_id == 0x58A and frame.data[1:4] == index.to_bytes(2, "little") + bytes((subindex,)) and not lies:
            lies.append(frame)
            frame = frame._replace(data=frame.data[:4] + setting.value.to_bytes(4, "little"))
        return shipped(frame, t_us)

    bench.driver.receive = receive
    bench.start()
    assert lies
    assert bench.driver.state is DriverState.FAILED
    assert "read-back" in bench.driver.failure


def test_a_constant_mapping_that_is_another_is_refused():
    bench = Bench(DriverConfig())
    for variable in bench.node.object_dictionary[0x1601].values():
        variable.access_type = "const"
    bench.node.object_dictionary[0x1601][2].default = 0x64110110
    bench.start()
    assert "writing 0x1601:00 (mapping of the drive PDO, cleared) was refused: 0x06010002" in bench.driver.failure


@pytest.mark.parametrize(("value", "sent"), [(0, [b"", b"", b""]), (2, [b"\1", b"\2", b"\1"])])
def test_a_counter_of_sync_that_cannot_be_changed_is_followed(value, sent):
    bench = Bench(DriverConfig())
    overflow = bench.node.object_dictionary[0x1019]
    overflow.default, overflow.access_type = value, "const"
    bench.start()
    assert (bench.driver.state, bench.driver.failure) == (DriverState.OPERATIONAL, "")
    assert [bench.driver.sync(0).data for _ in sent] == sent


PROVEN = {"vendor_id": 0x7078797A, "product_code": 3, "revision": 0x10000, "serial": 1, "digest": "sha256:" + 64 * "0"}


@pytest.mark.parametrize("serial", [1, 2])
@pytest.mark.parametrize(
    ("index", "lines"),
    [(0x6443, ("heartbeat lost", "leaving operational")), (0x6444, ("heartbeat lost",)), (0x1016, ("drive time-out",))],
)
def test_a_passed_report_stands_in_for_what_a_node_lacks_if_it_is_of_this_very_module(index, lines, serial):
    config = DriverConfig(proven=ProvenModule(**{**PROVEN, "serial": serial, "lines": lines}))
    bench = Bench(config, consumes=False)
    del bench.node.object_dictionary[index]
    bench.start()
    accepted = serial == 1 and lines != ("heartbeat lost",)
    assert bench.driver.state is (DriverState.OPERATIONAL if accepted else DriverState.FAILED)
    assert (f"no 0x{index:04X}" in str(bench.driver.lost)) == accepted
    assert ("it is of another module" in str(bench.driver.lost)) == (serial == 2)


def test_a_module_that_is_known_is_not_tried_again():
    bench = Bench(DriverConfig())
    bench.start()
    first_us = bench.t_us
    bench.start()
    assert bench.driver.state is DriverState.OPERATIONAL
    assert bench.t_us - first_us < first_us - 50_000
    del bench.node.object_dictionary[0x1018].subindices[4]  # a module without serial number may be another one
    bench.consumes = False
    bench.start()
    assert bench.driver.state is DriverState.FAILED


def test_other_pdos_and_channels():
    config = DriverConfig(
        drive_pdo=1, sense_pdo=3, drive_channels=(2, 3, 4), sense_channels=(5, 6, 7), protection=False, vendor_id="any"
    )
    bench = Bench(config)
    dictionary = bench.node.object_dictionary
    for there, wanted in ((0x1401, 0x1400), (0x1601, 0x1600), (0x1801, 0x1802), (0x1A01, 0x1A02)):
        record = canopen.objectdictionary.ODRecord(f"of {wanted:X}", wanted)
        for variable in dictionary[there].values():
            moved = copy(variable)
            moved.index, moved.parent = wanted, record
            record.add_member(moved)
        dictionary.add_object(record)
    for index in (0x6443, 0x6444):
        extra = copy(dictionary[index][3])
        extra.subindex = 4
        dictionary[index].add_member(extra)
    bench.start()
    assert (bench.driver.state, bench.driver.failure) == (DriverState.OPERATIONAL, "")
    sdo = bench.node.sdo
    assert (sdo[0x1400][1].raw, sdo[0x1802][1].raw) == (0x20A, 0x4000038A)
    assert [sdo[0x1600][place].raw for place in (1, 2, 3)] == [0x64110210, 0x64110310, 0x64110410]
    assert [sdo[0x1A02][place].raw for place in (1, 2, 3)] == [0x64010510, 0x64010610, 0x64010710]
    assert bench.driver.drive((1, 2, 3), 0).can_id == 0x20A
    bench.driver.sync(0)
    bench.driver.receive(Frame(0x38A, b"\1\0\2\0\3\0"), 0)
    assert bench.driver.sense.take() == (1, 2, 3, 0)
    assert 'identity "any"' in bench.driver.lost[0]
    assert "protection = false" in bench.driver.lost[1]


def test_a_lost_answer_costs_one_time_out():
    bench = Bench(DriverConfig(sdo_timeout_us=3_000))
    answered = bench.from_node
    lost = []

    def lose_the_twentieth() -> list[Frame]:
        frames = answered()
        if len(lost) < 20 and any(frame.can_id == 0x58A for frame in frames):
            lost.append(frames)
            return [] if len(lost) == 20 else frames
        return frames

    undisturbed = Bench(DriverConfig(sdo_timeout_us=3_000))
    undisturbed.start()
    bench.from_node = lose_the_twentieth
    bench.start()
    assert bench.driver.state is DriverState.OPERATIONAL
    assert 3_000 <= bench.t_us - undisturbed.t_us <= 3_000 + 3 * FRAME_US


def test_a_reset_while_running_is_seen_and_a_new_start_succeeds():
    bench = Bench(DriverConfig())
    bench.start()
    bench.node.nmt.send_command(129)
    for frame in bench.from_node():
        bench.driver.receive(frame, bench.t_us)
    assert bench.driver.state is DriverState.FAILED
    assert bench.driver.node_events & NODE_REBOOTED
    bench.start()
    assert bench.driver.state is DriverState.OPERATIONAL
    assert bench.driver.node_events == 0
