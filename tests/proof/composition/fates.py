"""What may happen where the code does not decide, to a frame or by whoever operates; and what never may, to combs."""

from collections.abc import Callable
from typing import Any

from any_law import sense_counts_at_rest
from configurations import HARD, LEVELS, MAXIMUM, SOFT, STEP, Configuration

from hil.node.amplifier import NmtState
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.safety.modes import Event, Mode

Option = tuple[Any, ...]


def damaged(frame: Frame) -> list[Frame]:
    """What a frame may have become that still is one."""
    can_id, data, flags = frame
    made: list[bytes] = []
    match can_id:
        case 0x080:
            made = [bytes(((data[0] + 6) % 240 + 1,)), b""] if data else []
        case 0x30A | 0x28A:
            made = [bytes((data[0] ^ 1, *data[1:])), data[:-1]] if data else []
        case 0x20A:
            made = [bytes((data[0] ^ 1,)), b""]
        case 0x38A:
            made = [bytes((data[0] ^ 1, *data[1:])), data[:-1]]
        case 0x77F:
            made = [b"\x00"]
        case 0x70A:
            made = [bytes((state,)) for state in (0, 4) if data != bytes((state,))]
        case 0x08A:
            made = [bytes((0, 0x10 if data[:2] == b"\0\0" else 0)) + data[2:]]
        case 0x000:
            made = [bytes((command, *data[1:])) for command in (1, 2, 0x80, 0x81) if command != data[0]]
        case 0x60A:
            made = [data[:4] + bytes((data[4] ^ 1,)) + data[5:], data[:1] + b"\xff\x5f" + data[3:]]
        case 0x58A:
            made = [data[:4] + bytes((data[4] ^ 1,)) + data[5:], b"\x80" + data[1:4] + b"\0\0\0\x08"]
    return [Frame._make((can_id, payload, flags)) for payload in made]


def wishes_of(controller: Controller, configuration: Configuration) -> list[Option]:
    """What an operator, a monitor and a law may want in this tick; of the digital outputs anything in every mode in
    which they are sent at all.
    """
    wishes = _of_combs(controller, configuration.levels)
    bits = configuration.outputs if may_put_out(controller.mode) else configuration.outputs[:1]
    return [(*wish, wanted) for wish in wishes for wanted in bits]


def may_put_out(mode: int) -> bool:
    """Whether digital outputs may be asked of the node."""
    return mode >= Mode.IDLE and mode != Mode.FAULT


def _of_combs(controller: Controller, levels: tuple[Counts, ...]) -> list[Option]:
    mode = Mode(controller.mode)
    match mode:
        case Mode.IDLE:
            wishes: list[Option] = [("tick", event, LEVELS[0], 0) for event in (Event.NONE, Event.HOME, Event.ENABLE)]
        case Mode.HOMING:
            wishes = [("tick", event, LEVELS[0], 0) for event in (Event.NONE, Event.DISABLE)]
        case Mode.ENABLED | Mode.TRACKING:
            wishes = [("tick", Event.NONE, counts, 0) for counts in levels]
            wishes += [("tick", Event.DISABLE, LEVELS[0], 0)]
            wishes += [("tick", Event.NONE, LEVELS[0], int(trip)) for trip in (SOFT, HARD)]
        case Mode.LANDING:
            wishes = [("tick", Event.NONE, counts, 0) for counts in levels]
            wishes += [("tick", Event.NONE, LEVELS[0], int(trip)) for trip in (SOFT, HARD)]
        case Mode.FAULT:
            wishes = [("tick", event, LEVELS[0], 0) for event in (Event.NONE, Event.CLEAR)]
        case _:
            wishes = [("tick", Event.NONE, LEVELS[0], 0)]
            if controller.driver.state is DriverState.FAILED:
                wishes.append(("tick", Event.CLEAR, LEVELS[0], 0))
    return wishes


class ViolationError(Exception):
    """An invariant does not hold."""


class Plant:
    """What the amplifier drives: holds counts, shows the stage at rest, and says what must never happen to combs."""

    def __init__(self, node_state: Callable[[], NmtState]) -> None:
        self._node_state = node_state
        self.counts: Counts = (0, 0, 0)
        self._sample = sense_counts_at_rest()

    def exchange(self, t_us: int, counts: Counts | None, *, sample: bool) -> Counts:
        if counts is not None:
            self._drive(counts)
        return self._sample

    def _drive(self, counts: Counts) -> None:
        before, self.counts = self.counts, (int(counts[0]), int(counts[1]), int(counts[2]))
        if not all(0 <= count <= MAXIMUM for count in counts):
            raise ViolationError(f"comb counts {counts} beyond 0..{MAXIMUM}")
        if any(counts) and any(abs(new - old) > STEP for new, old in zip(counts, before, strict=True)):
            raise ViolationError(f"a step from {before} to {counts}, beyond {STEP} in a tick")
        if any(counts) and self._node_state() is not NmtState.OPERATIONAL:
            raise ViolationError(f"{counts} driven while the node is {self._node_state().name}")
