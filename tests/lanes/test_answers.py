"""How long the loop takes to answer a sense frame is counted where frames go and come."""

from types import SimpleNamespace

import pytest

from hil.lanes import wall
from hil.lanes.wall import _LoggedPort
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import Frame

SYNC, SENSE, DRIVE, OUTPUT = (Frame(can_id, bytes(8)) for can_id in (0x080, 0x28B, 0x30B, 0x20B))


@pytest.fixture
def machine(monkeypatch):
    """Its clock, and a bus that takes 10 us to hand a frame over; it refuses what is to be refused."""
    machine = SimpleNamespace(now_us=1000, coming=[], refuses=False)
    monkeypatch.setattr(wall, "time", SimpleNamespace(monotonic_ns=lambda: machine.now_us * 1000))

    def send(frame):
        machine.now_us += 10
        return not machine.refuses

    bus = SimpleNamespace(send=send, receive=lambda until_us: machine.coming.pop(), unsent=lambda: 0, last_us=0)
    clock, recorder = SimpleNamespace(now_us=0), SimpleNamespace(frame=lambda frame, t_us: None)
    machine.port = _LoggedPort(bus, clock, recorder, DriverConfig(node_id=11))
    return machine


def played(machine, *happenings):
    """What was counted while frames were received, ``Frame``, sent, ``[Frame]``, and microseconds went by."""
    for happening in happenings:
        if isinstance(happening, int):
            machine.now_us += happening
        elif isinstance(happening, list):
            machine.port.send(*happening)
        else:
            machine.coming.append(happening)
            machine.port.receive(0)
    return {us: count for us, count in enumerate(machine.port.answer_us) if count}


def test_an_answer_lasts_from_the_sense_frame_read_to_the_drive_frame_handed_over(machine):
    assert played(machine, [SYNC], 7, SENSE, 20, [DRIVE], [OUTPUT]) == {30: 1}
    assert played(machine, [SYNC], 7, SENSE, OUTPUT, 20, [DRIVE]) == {30: 2}
    assert played(machine, [SYNC], 7, SENSE, 2500, [DRIVE], [SYNC], SENSE, 1990, [DRIVE]) == {30: 2, 1999: 2}


def test_what_answers_nothing_is_not_counted(machine):
    """A drive frame without a sense frame, one behind it, and one whose sense frame came before the tick began."""
    assert played(machine, [SYNC], 7, [DRIVE]) == {}
    assert played(machine, SENSE, 3, [SYNC], 7, [DRIVE]) == {}
    assert played(machine, [SYNC], SENSE, [DRIVE], [DRIVE]) == {10: 1}


def test_what_the_bus_refuses_is_no_answer(machine):
    machine.refuses = True
    assert played(machine, [SYNC], SENSE, [DRIVE]) == {}
