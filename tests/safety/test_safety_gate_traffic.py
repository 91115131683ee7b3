"""The transmit gate in traffic: whatever a controller sends, the combs stay within their limits."""

import struct
from dataclasses import dataclass, field

from gate_frames import CONFIG, DRIVE_ID, crc8h2f, drive, nmt, sync
from hypothesis import given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety.gate import TransmitGate
from pkxyz_ctrl.safety.modes import MAY_ENERGISE, Mode

T = 200


@dataclass
class Combs:
    """What an amplifier makes of the frames that passed: its combs step at SYNC, and rest after five without a frame.

    It ignores a frame whose alive counter is not the next, as ours does.
    """

    counts: tuple[int, ...] = (0, 0, 0)
    pending: tuple[int, ...] | None = None
    counter: int | None = None
    syncs: int = 0
    steps: list[tuple[tuple[int, ...], tuple[int, ...]]] = field(default_factory=list)

    def take(self, frame: Frame) -> None:
        if frame.can_id == 0x080:
            self.syncs += 1
            to = (0, 0, 0) if self.pending is None and self.syncs >= 5 else self.pending
            if to is not None:
                self.steps.append((self.counts, to))
                self.counts = to
            if self.pending is not None:
                self.syncs = 0
            self.pending = None
        elif frame.can_id == DRIVE_ID:
            *counts, counter, _ = struct.unpack("<hhhBB", frame.data)
            if self.counter is None or counter == (self.counter + 1) % 256:
                self.pending = tuple(counts)
            self.counter = counter
        elif frame.can_id == 0x000 and frame.data[0] in (0x81, 0x82):
            self.counts, self.pending, self.counter, self.syncs = (0, 0, 0), None, None, 0


@st.composite
def traffic(draw: st.DrawFn) -> list[tuple[str, int, int, tuple[int, ...]]]:
    """What a confused controller does: mostly ordinary ticks, with anything in between."""
    action = st.sampled_from(
        ["tick"] * 10 + ["voltage", "zero", "sync", "jump", "bad crc", "reset", "stop", "stray", "clear", "clear"]
    )
    step = st.one_of(st.integers(-1000, 1000), st.sampled_from([-1001, 1001, -30000, 30000]))
    mode = st.sampled_from([Mode.TRACKING] * 8 + [Mode.ENABLED, Mode.IDLE, Mode.FAULT, Mode.BOOT])
    wait = st.sampled_from([T, T, T, T, 100, 99, 1, 0, 10 * T])
    return draw(st.lists(st.tuples(action, mode, wait, st.tuples(step, step, step)), max_size=60))


def clamp16(value: int) -> int:
    return max(-32768, min(32767, value))


@settings(max_examples=150)
@given(traffic())
def test_random_traffic_never_moves_the_combs_beyond_limits(
    actions: list[tuple[str, int, int, tuple[int, ...]]],
) -> None:
    """Whatever is asked: at the combs no step beyond slew (but to 0 V), no voltage beyond range or in a wrong mode."""
    gate, combs = TransmitGate(CONFIG), Combs()
    t_us, counter = 0, 0
    passed = 0

    def send(frame: Frame, mode: int) -> None:
        nonlocal passed
        was_latched = gate.latched
        if gate.check(frame, mode, t_us) is not None:
            assert gate.latched
            return
        passed += 1
        combs.take(frame)
        if frame.can_id == DRIVE_ID:
            counts = struct.unpack("<hhh", frame.data[:6])
            assert all(0 <= count <= CONFIG.count_max for count in counts)
            assert counts == (0, 0, 0) or (MAY_ENERGISE[mode] and not was_latched)
            assert frame.data[7] == crc8h2f(struct.pack("<H", DRIVE_ID) + frame.data[:7])

    send(drive(0, 0, 0, counter), Mode.IDLE)
    for action, mode, wait_us, step in actions:
        t_us += wait_us
        if action in ("tick", "sync"):
            send(sync(), mode)
        if action in ("tick", "voltage", "bad crc", "jump"):
            near = tuple(clamp16(count + change) for count, change in zip(combs.counts, step, strict=True))
            a, b, c = near if MAY_ENERGISE[mode] or action == "voltage" else (0, 0, 0)
            counter += 2 if action == "jump" else 1
            frame = drive(a, b, c, counter)
            spoilt = frame._replace(data=frame.data[:7] + bytes([frame.data[7] ^ 0x80]))
            send(spoilt if action == "bad crc" else frame, mode)
        elif action == "zero":
            counter += 1
            send(drive(0, 0, 0, counter), mode)
        elif action in ("reset", "stop"):
            send(nmt(0x81 if action == "reset" else 0x02), mode)
        elif action == "stray":
            send(Frame(0x123, b""), mode)
        elif action == "clear":
            gate.clear()
    for was, now in combs.steps:
        within = all(abs(b - a) <= CONFIG.count_slew_max for a, b in zip(was, now, strict=True))
        assert within or now == (0, 0, 0), (was, now)
    assert passed >= 1


def test_ordinary_scan_passes_whole() -> None:
    """10 000 ticks up and down the range at nearly the slew limit: nothing is blocked, the counter wraps."""
    gate, combs = TransmitGate(CONFIG), Combs()
    level, direction = 0, 990
    for k in range(10_000):
        if not 0 <= level + direction <= 30000:
            direction = -direction
        level = level + direction if k else 0
        for frame in (sync(k % 240 + 1), drive(level, level // 2, level // 3, k)):
            assert gate.check(frame, Mode.TRACKING if k else Mode.IDLE, k * T) is None
            combs.take(frame)
    assert max(counts[0] for _, counts in combs.steps) > 29000
