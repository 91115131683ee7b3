"""The python-can interface: what python-can, canopen and cantools see of the wire, in simulated time and no threads."""

import itertools
import threading

import can
import canopen
import canopen.objectdictionary
import cantools.database
import pytest

from hil.bus.clock import Lockstep
from hil.bus.published_wires import publish
from hil.bus.sim_bus import SimBus, to_frame, to_message
from hil.bus.wire import Wire
from pkxyz_ctrl.can.frame import Frame

_channels = (f"test-bus-{n}" for n in itertools.count())


@pytest.fixture
def channel() -> str:
    return next(_channels)


@pytest.fixture
def pair(channel: str):
    with SimBus(channel, fd=True) as a, SimBus(channel) as b:
        yield a, b


def message(can_id: int = 0x123, data: bytes = b"\x01\x02", **kinds: bool) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=kinds.pop("is_extended_id", False), **kinds)


def test_python_can_finds_it_by_name(channel: str) -> None:
    with (
        can.Bus(interface="pkxyz-sim", channel=channel, fd=True, bitrate=500_000, data_bitrate=2_000_000) as a,
        can.Bus(interface="pkxyz-sim", channel=channel) as b,
    ):
        assert isinstance(a, SimBus)
        assert a.wire is b.wire
        assert (a.wire.nominal_bitrate, a.wire.data_bitrate) == (500_000, 2_000_000)
        assert a.protocol == can.CanProtocol.CAN_FD
        a.send(message())
        assert b.recv(1.0).data == b"\x01\x02"


def test_it_attaches_to_a_published_wire_or_makes_one_and_refuses_other_rates(channel: str) -> None:
    wire = Wire(Lockstep(), 250_000)
    publish(wire, channel)
    with SimBus(channel, bitrate=250_000, fd=False) as bus:
        assert bus.wire is wire
        assert bus.protocol == can.CanProtocol.CAN_20
        for other in ({"fd": True}, {"bitrate": 500_000}, {"data_bitrate": 1_000_000}):
            with pytest.raises(can.CanInitializationError, match="exists with"):
                SimBus(channel, **other)
        with pytest.raises(can.CanOperationError, match="classic wire"):
            bus.send(message(is_fd=True))
    with pytest.raises(can.CanInitializationError, match="bit rates"):
        SimBus(channel + "x", bitrate=1_000_000, data_bitrate=10_000)
    with pytest.raises(can.CanInitializationError, match="needs fd"):
        SimBus(channel + "x", fd=False, data_bitrate=5_000_000)
    with pytest.raises(TypeError):
        can.Bus(interface="pkxyz-sim", channel=channel, no_such_option=1)


@pytest.mark.parametrize(
    "frame",
    [
        Frame(0x123, b"\x01\x02\x03"),
        Frame(0x123, b""),
        Frame(0x1234567, b"\xff" * 8, is_extended=True),
        Frame(0x123, bytes(4), is_remote=True),
        Frame(0x123, bytes(64), True, True),
        Frame(0x123, b"\x05" * 12, True, False),
        Frame(0x088, bytes(8), is_error=True),
    ],
)
def test_frames_and_messages_say_the_same(frame: Frame) -> None:
    there = to_message(frame, 1_234_567, "vcan7")
    assert to_frame(there) == frame
    assert there.timestamp == pytest.approx(1.234567, abs=1e-12)
    assert (there.channel, there.is_rx, there.dlc) == ("vcan7", True, len(frame.data))


def test_receiving_lets_simulated_time_pass_and_no_more_than_asked(pair: tuple[SimBus, SimBus]) -> None:
    a, b = pair
    clock = a.wire.clock
    assert b.recv(0) is None
    assert b.recv(0.25) is None
    assert clock.now_us == 250_000
    a.send(message())
    assert b.recv(0) is None  # it is only queued
    received = b.recv(1.0)
    assert received.timestamp == pytest.approx(clock.now_us * 1e-6)
    assert 250_000 + 50 < clock.now_us < 250_000 + 80
    assert b.recv() is None  # nothing is left that could happen
    clock.call_at(clock.now_us + 500, lambda: a.send(message(data=b"late")))
    assert b.recv().data == b"late"


def test_inside_an_event_receiving_never_waits(pair: tuple[SimBus, SimBus]) -> None:
    a, b = pair
    got = []
    a.send(message())
    a.wire.clock.call_at(10, lambda: got.append(b.recv(1.0)))
    a.wire.clock.call_at(200, lambda: got.append(b.recv(1.0)))
    a.wire.clock.run_until(1000)
    assert got[0] is None
    assert got[1].arbitration_id == 0x123


def test_filters_own_messages_and_queue_limit(channel: str) -> None:
    with (
        SimBus(channel, can_filters=[{"can_id": 0x100, "can_mask": 0x7F0, "extended": False}]) as choosy,
        SimBus(channel, receive_own_messages=True, queue_limit=3) as own,
    ):
        for can_id in (0x0FF, 0x100, 0x10F, 0x110):
            assert choosy.overruns == own.overruns == 0
            own.send(message(can_id), timeout=0.01)
        assert [m.arbitration_id for m in (choosy.recv(0.01), choosy.recv(0.01))] == [0x100, 0x10F]
        assert choosy.recv(0.01) is None
        assert [(m.arbitration_id, m.is_rx) for m in iter(lambda: own.recv(0), None)] == [
            (0x0FF, False),
            (0x100, False),
            (0x10F, False),
        ]
        assert own.overruns == 1
        choosy.set_filters(None)
        own.send(message(0x700))
        assert choosy.recv(0.01).arbitration_id == 0x700


def test_a_full_queue_waits_as_long_as_it_may(channel: str) -> None:
    with SimBus(channel, queue_limit=1) as a, SimBus(channel) as b:
        a.send(message(data=b"1"))
        with pytest.raises(can.CanOperationError, match="queue is full"):
            a.send(message(data=b"2"))
        a.send(message(data=b"3"), timeout=0.001)
        assert [b.recv(0.01).data, b.recv(0.01).data] == [b"1", b"3"]
        a.send(message(data=b"4"))
        a.flush_tx_buffer()
        assert b.recv(0.01) is None


def test_error_frames_states_and_bus_off(pair: tuple[SimBus, SimBus]) -> None:
    a, b = pair
    a.wire.disturbance.corrupt_next()
    a.send(message())
    error, good = b.recv(0.01), b.recv(0.01)
    assert error.is_error_frame
    assert not good.is_error_frame
    assert a.state == can.BusState.ACTIVE
    a.wire.disturbance.corrupt_next(count=10_000)
    a.send(message())
    while a.state == can.BusState.ACTIVE:
        b.recv(0.0001)
    assert a.state == can.BusState.PASSIVE
    while a.state == can.BusState.PASSIVE:
        b.recv(0.0001)
    assert a.state == can.BusState.ERROR
    with pytest.raises(can.CanOperationError, match="bus-off"):
        a.send(message())
    with pytest.raises(can.CanOperationError, match="follows from what happens on the wire"):
        a.state = can.BusState.ACTIVE


def test_periodic_messages_come_from_the_clock_and_not_from_a_thread(pair: tuple[SimBus, SimBus]) -> None:
    a, b = pair
    threads = threading.active_count()
    task = a.send_periodic(message(0x080, b"\x01"), 0.001, duration=0.005)
    assert threading.active_count() == threads
    times = [m.timestamp for m in iter(lambda: b.recv(0.01), None)]
    assert [round(1e6 * (t - times[0])) for t in times] == [0, 1000, 2000, 3000, 4000]
    task = a.send_periodic(message(0x080, b"\x01"), 0.001)
    assert b.recv(0.01).data == b"\x01"
    task.modify_data(message(0x080, b"\x02"))
    assert b.recv(0.01).data == b"\x02"
    task.stop()
    assert b.recv(0.01) is None
    task.start()
    task.start()  # not twice as often
    times = [b.recv(0.01).timestamp for _ in range(4)]
    assert [round(1e6 * (t - times[0])) for t in times] == [0, 1000, 2000, 3000]
    task.stop()
    a.send_periodic([message(0x080, b"\x04"), message(0x080, b"\x05")], 0.001)
    assert [b.recv(0.01).data[0] for _ in range(5)] == [4, 5, 4, 5, 4]
    a.stop_all_periodic_tasks()
    assert b.recv(0.01) is None


def object_dictionary() -> canopen.ObjectDictionary:
    dictionary = canopen.ObjectDictionary()
    for index, name, kind in (
        (0x1000, "Device type", canopen.objectdictionary.UNSIGNED32),
        (0x1018, "Name", canopen.objectdictionary.VISIBLE_STRING),
    ):
        variable = canopen.objectdictionary.ODVariable(name, index)
        variable.data_type, variable.access_type = kind, "rw"
        dictionary.add_object(variable)
    return dictionary


class PumpedNetwork(canopen.Network):
    """A network whose requests are answered before ``send_message`` returns, since simulated time passes in it."""

    def __init__(self, bus: SimBus, peers: list[canopen.Network]) -> None:
        super().__init__(bus)
        self.peers = peers

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        super().send_message(can_id, data, remote)
        for _ in range(4):
            for network in (*self.peers, self):
                while (received := network.bus.recv(0.0005)) is not None:
                    if not received.is_error_frame:
                        network.notify(received.arbitration_id, received.data, received.timestamp)


def test_canopen_reads_and_writes_objects_over_it_without_threads(channel: str) -> None:
    threads = threading.active_count()
    with SimBus(channel, bitrate=1_000_000) as master_bus, SimBus(channel) as node_bus:
        node_network = canopen.Network(node_bus)
        local = canopen.LocalNode(10, object_dictionary())
        node_network.add_node(local)
        local.sdo[0x1000].raw = 0x000C0191
        master = PumpedNetwork(master_bus, [node_network])
        remote = canopen.RemoteNode(10, object_dictionary())
        master.add_node(remote)
        assert remote.sdo[0x1000].raw == 0x000C0191
        long_name = "a name that is longer than the four bytes of an expedited transfer"
        remote.sdo[0x1018].raw = long_name  # segmented, both ways
        assert local.sdo[0x1018].raw == long_name
        assert remote.sdo[0x1018].raw == long_name
        with pytest.raises(canopen.SdoAbortedError) as abort:
            remote.sdo.upload(0x2222, 0)
        assert abort.value.code == 0x06020000  # CiA 301: object does not exist
    assert threading.active_count() == threads


def test_cantools_decodes_what_arrives(pair: tuple[SimBus, SimBus]) -> None:
    a, b = pair
    database = cantools.database.load_string(
        'VERSION ""\nBU_: A\nBO_ 778 Drive: 8 A\n SG_ volt : 0|16@1- (0.0061037,0) [-200|200] "V" A\n'
        ' SG_ alive : 48|8@1+ (1,0) [0|255] "" A\n',
        "dbc",
    )
    a.send(message(778, database.encode_message("Drive", {"volt": 130.0, "alive": 7}), is_fd=True, bitrate_switch=True))
    received = b.recv(0.01)
    decoded = database.decode_message(received.arbitration_id, received.data)
    assert decoded["volt"] == pytest.approx(130.0, abs=0.0061037 / 2)
    assert decoded["alive"] == 7


@pytest.mark.parametrize(
    ("writer", "reader", "suffix"),
    [
        (can.ASCWriter, can.ASCReader, "asc"),
        (can.BLFWriter, can.BLFReader, "blf"),
        (can.CanutilsLogWriter, None, "log"),
    ],
)
def test_python_cans_writers_and_readers_take_its_messages(pair, tmp_path, writer, reader, suffix) -> None:
    a, b = pair
    path = tmp_path / f"frames.{suffix}"
    sent = [message(0x100 + k, bytes([k]) * k, is_fd=k % 2 == 0, bitrate_switch=k % 2 == 0) for k in range(1, 9)]
    received = []
    with writer(path) as sink:
        for each in sent:
            a.send(each)
            received.append(b.recv(0.01))
            sink(received[-1])
    reread = list((reader or can.CanutilsLogReader)(path))
    assert [to_frame(m) for m in reread] == [to_frame(m) for m in sent]
    # the formats keep no more than microseconds, and some count from the first message
    shifts = [there.timestamp - here.timestamp for there, here in zip(reread, received, strict=True)]
    assert max(shifts) - min(shifts) < 2e-6


def test_shut_down_it_is_off_the_wire(channel: str) -> None:
    a, b = SimBus(channel), SimBus(channel)
    task = a.send_periodic(message(), 0.001)
    a.shutdown()
    a.shutdown()
    del task
    assert b.recv(0.1) is None
    with pytest.raises(can.CanOperationError, match="detached"):
        a.send(message())
    b.shutdown()
    wire = a.wire
    assert wire.statistics().frames <= 1
