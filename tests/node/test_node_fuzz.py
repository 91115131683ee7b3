"""Hostile frames: the node never raises, and no comb is ever driven but by a valid drive PDO in operational."""

from typing import Any

from hypothesis import event, given, settings
from hypothesis import strategies as st
from node_rig import CONTROLLER, DRIVE, NODE_ID, REQUEST, SYNC, RecordingPlant, Rig, protected

from hil.node.amplifier import NmtState
from pkxyz_ctrl.can.frame import UNUSUAL, Frame

ZERO = (0, 0, 0)
COUNTS = st.tuples(*[st.integers(-32768, 32767)] * 3)
# objects that are allowed to change what may drive the combs: error mode and value, and the drive PDO's own parameters
MAY_CHANGE_THE_DRIVE = (0x6443, 0x6444, 0x1401, 0x1601)

anything = st.builds(
    Frame,
    st.integers(0, 0x7FF) | st.sampled_from([0, SYNC, DRIVE, REQUEST, CONTROLLER]) | st.integers(0x800, 0x1FFFFFFF),
    st.binary(max_size=8) | st.binary(max_size=64),
    st.booleans(),
    st.booleans(),
    *[st.sampled_from([False, False, False, True])] * 3,
)
drive_pdo = st.builds(
    lambda counts, counter: Frame(DRIVE, protected(DRIVE, counts, counter)), COUNTS, st.integers(0, 255)
)
nmt = st.builds(
    lambda command, node: Frame(0, bytes((command, node))),
    st.sampled_from([1, 1, 2, 128, 129, 130]),
    st.sampled_from([0, NODE_ID, 11]),
)
sync = st.builds(lambda n: Frame(SYNC, bytes((n,))), st.integers(0, 255))
heartbeat = st.sampled_from([Frame(CONTROLLER, b"\x05"), Frame(CONTROLLER, b"\x00")])


def _download(index: int, subindex: int, value: bytes, length: int) -> Frame:
    return Frame(REQUEST, bytes((0x23 | (4 - length) << 2, index & 0xFF, index >> 8, subindex)) + value)


OBJECTS = sorted({entry.index for entry in Rig().node.od})
sdo = st.builds(
    _download,
    st.sampled_from(OBJECTS),
    st.integers(0, 9),
    st.binary(min_size=4, max_size=4),
    st.integers(1, 4),
) | st.builds(lambda data: Frame(REQUEST, data), st.binary(min_size=8, max_size=8))


class Cycle:
    """Placeholder for "the next drive PDO in sequence, and a SYNC", which depend on how many went before."""


chosen = st.one_of(anything, drive_pdo, nmt, sync, sync, heartbeat, sdo, *[st.just(Cycle())] * 3)
steps = st.lists(st.tuples(chosen, st.sampled_from([0, 1, 40, 100, 2000])), min_size=5, max_size=80)


def _touches_the_drive(frame: Frame) -> bool:
    return frame.can_id == REQUEST and int.from_bytes(frame.data[1:3], "little") in MAY_CHANGE_THE_DRIVE


@given(steps, st.booleans())
@settings(max_examples=250)
def test_no_frames_break_the_node_or_drive_a_comb(script: list[tuple[Any, int]], start: bool) -> None:
    rig = Rig()
    rig.write(0x1016, 1, 127 << 16 | 3, 4)
    plant = Watched(rig)
    rig.node._plant = plant
    if start:
        rig.start()
    counter = 0
    for frame, wait_us in script:
        if isinstance(frame, Cycle):
            counter = (counter + 1) % 256
            plant.allowed.add((counter + 1, 2, 3))
            rig.give(DRIVE, protected(DRIVE, (counter + 1, 2, 3), counter))
            frame = Frame(SYNC, bytes((1 + counter % 240,)))
        if _touches_the_drive(frame):
            continue
        if frame.can_id == DRIVE and len(frame.data) == 8 and not frame.flags & UNUSUAL:
            a, b, c = (int.from_bytes(frame.data[i : i + 2], "little", signed=True) for i in (0, 2, 4))
            if min(a, b, c) >= 0 and frame.data == protected(DRIVE, (a, b, c), frame.data[6]):
                plant.allowed.add((a, b, c))
        rig.node.on_frame(frame, rig.now_us)
        rig.run(wait_us)
        if rig.node.state is not NmtState.OPERATIONAL:
            assert rig.node.outputs == ZERO
    event(f"driven: {plant.was_driven}")
    for _, frame in rig.sent:
        assert frame.can_id in (0x8A, 0x70A, 0x58A, rig.node._sense_pdo.cob_id) or len(frame.data) == 8
        assert len(frame.data) <= 8


class Watched(RecordingPlant):
    """Lets pass only what a drive PDO has asked for, and that only in operational."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self.t_us = rig.now_us
        self.allowed: set[tuple[int, int, int]] = set()
        self.was_driven = False
        self._rig = rig

    def drive(self, counts: tuple[int, int, int]) -> None:
        super().drive(counts)
        if counts != ZERO:
            assert counts in self.allowed
            assert self._rig.node.state is NmtState.OPERATIONAL
            self.was_driven = True


@given(st.lists(sdo, max_size=60))
@settings(max_examples=150)
def test_every_sdo_request_has_one_reply_and_the_mapping_stays_sound(requests: list[Frame]) -> None:
    """Whatever was written to the PDO parameters, both PDOs can be started and cycled."""
    rig = Rig()
    for frame in requests:
        rig.node.on_frame(frame, rig.now_us)
        replies = len(rig.of(0x58A))
        assert replies == (frame.data[0] >> 5 != 4)
        rig.forget()
        rig.run(10)
    rig.start()
    for counter in range(3):
        rig.give(rig.node._drive_pdo.cob_id, protected(rig.node._drive_pdo.cob_id, (1, 1, 1), counter))
        rig.give(rig.node.od[0x1005, 0] & 0x7FF, bytes((counter + 1,)))
        rig.run(3000)
