"""The controller of one stage: driver, cycle and gate around one law. Frames in, frames out; time is handed in.

It owns no clock and no bus. ``runtime`` drives it, whoever owns the time. What it does is compiled, in ``exchange``;
here are the way to it, and the words.
"""

from collections.abc import Callable, Iterable
from struct import Struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.driver import AmplifierDriver, word_of
from pkxyz_ctrl.can.driver_rules import FRESH, OUTGOING, OUTGOING_MOST, START_UP
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.other_traffic import complaint
from pkxyz_ctrl.can.startup import Setting
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.config.bus import BusConfig, CanConfig
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.loop import exchange, law_change, outputs
from pkxyz_ctrl.loop.exchange import BLOCKED, EXCHANGE, EXCHANGE_MEMORY, NOT_RESTARTED, RESTARTED
from pkxyz_ctrl.loop.period import period_of
from pkxyz_ctrl.loop.reference import REFERENCE, standing_still
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.trips import Trip, explain

Send = Callable[[Frame], object]
Records = NDArray[np.void]

_OUTGOING: Final = Struct("<8siiii")
_PLACES: Final = tuple(place * OUTGOING.itemsize for place in range(OUTGOING_MOST))
_unpack = _OUTGOING.unpack_from
_word = Struct("<q").unpack
_new_tuple = tuple.__new__  # a Frame without its keyword defaults: 0.2 us less in every tick


class StartUpError(RuntimeError):
    """The amplifier could not be brought to operation; the message says what was expected, what came and what to do."""


class Controller:
    """One stage under control.

    ``send`` takes every frame that may go out; ``discard_unsent`` drops those that still wait, so that no voltage of
    before follows a fault decision; ``port_complaint`` says, as ``; ...``, what stands in the way of frames.
    ``faults`` collects a sentence for each fault decision. ``record`` (1,) of ``exchange.EXCHANGE`` is all that it goes
    by, ``exchange`` (1,) of ``EXCHANGE_MEMORY`` all that it remembers; ``memory`` (1,) of ``cycle.MEMORY`` is the
    cycle's part of that, ``outputs`` (1,) of ``outputs.OUTPUTS`` what the digital outputs go by, ``row`` the bytes of
    its latest record. ``settings``: what the start-up goes by, in place of
    ``startup.table``.
    """

    def __init__(
        self,
        law: Records,
        bus: BusConfig,
        gate: GateConfig,
        send: Send,
        discard_unsent: Callable[[], object] = lambda: None,
        port_complaint: Callable[[], str] = lambda: "",
        settings: tuple[Setting, ...] = (),
    ) -> None:
        if bus.can is None:
            raise ValueError(f"bus {bus.name!r} has no [can]: nothing to control over")
        self.can: CanConfig = bus.can
        self.record, self.exchange = np.zeros(1, EXCHANGE), np.zeros(1, EXCHANGE_MEMORY)
        self.law, self.memory = part(self.record, "law"), part(self.exchange, "cycle")
        self.outputs = part(self.exchange, "outputs")
        self.law[0] = law[0]
        self.driver = AmplifierDriver(
            bus.can.driver, gate.count_slew_max, settings, part(self.record, "driver"), part(self.exchange, "driver"),
            period_us=bus.period_us, short_frame_us=bus.can.short_frame_us,
        )  # fmt: skip
        self.gate = TransmitGate(gate, part(self.record, "gate"), part(self.exchange, "gate"))
        exchange.switch_on(self.exchange)
        self.faults: list[str] = []
        self._send = send
        self._discard_unsent = discard_unsent
        self._port_complaint = port_complaint
        self.row = part(self.memory, "row").view(np.uint8).data
        self._mode = self.memory["mode"].data  # 40 ns for a look
        self._out = part(self.exchange, "driver", "out").view(np.uint8).data
        self.period_us = bus.period_us
        self._reference = standing_still()  # the latest that was handed in
        self._load_kernels()

    def _load_kernels(self) -> None:
        """All that it calls: now, not in the first tick."""
        config, memory = self.record, self.exchange
        self._begin, self._prepare = direct(exchange.begin, config, memory, 0), direct(exchange.prepare, config, memory)
        self._on_frame = direct(exchange.on_frame, config, memory, *[0] * 5)
        self._finish = direct(exchange.finish, config, memory, 0, 0)
        self._start, self._wait = direct(exchange.start, config, memory, 0), direct(exchange.wait, config, memory, 0)
        self._come_up, self._stop = direct(exchange.come_up, memory), direct(exchange.stop, config, memory, 0)
        self._ask_to_clear = direct(exchange.ask_to_clear, memory)
        self._change_law = direct(law_change.take_over, self.law, self.memory, np.zeros(1, law_change.CHANGE))
        self._period = self._period_of()
        self._period(config, memory.copy(), self._reference, 0)

    def _period_of(self) -> Callable[..., Any]:
        """The compiled period, or the one that plans between its two parts."""
        if self.law["tick"]["kind"][0] != PREDICTIVE:
            return direct(exchange.period, self.record, self.exchange, self._reference, 0)
        cycle = period_of(self.law, self._reference)
        hand_over, take_over = (
            direct(exchange.hand_over, self.exchange, 0),
            direct(exchange.take_over, self.exchange, 0),
        )
        decide = direct(outputs.decide, self.law, self.memory, self.outputs, self._reference)

        def planning(config: Records, memory: Records, reference: Records, overrun: int) -> Any:
            was = hand_over(memory, overrun)
            law, inner = part(config, "law"), part(memory, "cycle")
            cycle(law, inner, reference)
            decide(law, inner, part(memory, "outputs"), reference)
            return take_over(memory, was)

        return planning

    @property
    def mode(self) -> int:
        """The mode after the last tick, a ``Mode``."""
        return self._mode[0]

    @property
    def missed_ticks(self) -> int:
        """Skipped, late on the wire, or without the sample that the node owed."""
        return int(self.exchange["missed_ticks"][0])

    @missed_ticks.setter
    def missed_ticks(self, count: int) -> None:
        self.exchange["missed_ticks"] = count

    # -- start and stop ---------------------------------------------------------------------------------------------

    def start(self, t_us: int) -> None:
        """Begin the start-up dialogue with the amplifier."""
        self.driver.emergencies.clear()
        self._pass_on(self._start(self.record, self.exchange, t_us), t_us)

    def dialogue(self, frame: Frame | None, t_us: int) -> bool:
        """One step of the start-up: a frame that came, or None if none came for a
        while. True once the node is operational.

        Raises ``StartUpError``, also for a frame that our own gate blocks: nobody would ever answer it.
        """
        if frame is not None:
            self.receive(frame, t_us)
        else:
            self._pass_on(self._wait(self.record, self.exchange, t_us), t_us)
        come_up = self._come_up(self.exchange)
        if self.exchange["blocked"][0]:
            raise StartUpError(self.faults[-1])
        if come_up < 0:
            raise StartUpError(self.failure)
        return bool(come_up)

    def stop(self, t_us: int) -> None:
        """0 V and pre-operational, whatever the mode."""
        self._pass_on(self._stop(self.record, self.exchange, t_us), t_us)

    def request(self, event: Event) -> None:
        """Ask for an event at the next tick: HOME, ENABLE, TRACK, HOLD, DISABLE."""
        self.exchange["event"] = event

    def hold_quietly(self, quiet: bool) -> None:
        """Ask for quiet holds, or no longer: less noise and less rejection while the set-point stands still."""
        self.memory["input"]["quiet"] = quiet

    def release(self) -> None:
        """Ask for 0 V, whatever runs: an operator's trip."""
        self.memory["input"]["trips"] |= int(Trip.OPERATOR)

    def settle(self, window_m: float, sigmas: float, dwell_s: float) -> None:
        """When the stage is in position: see ``outputs.settle``."""
        outputs.settle(self.outputs, window_m, sigmas, dwell_s, self.period_us * 1e-6)

    def aim(self, axis: int, direction: int, start_m: float, pitch_m: float, count: int) -> None:
        """Which positions are told: see ``outputs.aim``."""
        outputs.aim(self.outputs, axis, direction, start_m, pitch_m, count)

    def change_law(self, change: Records) -> None:
        """Another law, (1,) of ``law_change.CHANGE``, takes over before the next tick."""
        self._change_law(self.law, self.memory, change)

    def passed(self) -> Iterable[Records]:
        """The memory of the ticks since somebody looked last: of one."""
        return (self.memory,)

    @property
    def is_obeyed(self) -> bool:
        """Whether nothing that was asked for came too late: here, between two ticks, never."""
        return True

    @property
    def has_outputs(self) -> bool:
        """Whether the amplifier has digital outputs."""
        return bool(self.exchange["driver"]["has_outputs"][0, 0])

    def clear(self) -> None:
        """Ask to forget the fault. Once the combs have been at 0 V for long enough, gate, driver and node start anew,
        tick by tick, while the loop goes on; where that failed, it is tried again. Without a fault nothing happens.
        """
        self._ask_to_clear(self.exchange)

    # -- one tick ---------------------------------------------------------------------------------------------------

    def begin(self, t_us: int) -> None:
        """The tick begins: SYNC, on which the amplifier applies the last voltages and samples. In FAULT the node is
        taken out of operational besides.
        """
        told = self._begin(self.record, self.exchange, t_us)
        self._pass_on(told, t_us)
        if told & NOT_RESTARTED:
            self._not_restarted()

    def receive(self, frame: Frame, t_us: int) -> bool:
        """Take a frame from the bus; True once this tick's sense values are there."""
        can_id, data, flags = frame
        length = len(data)
        word = _word(data)[0] if length == 8 else word_of(data)
        told = self._on_frame(self.record, self.exchange, can_id, flags, length, word, t_us)
        if told > FRESH:
            self.driver.told(frame, told, t_us)
            if told & START_UP:
                self._pass_on(BLOCKED | int(self.exchange["driver"]["outgoing"][0, 0]), t_us)
        return told & FRESH != 0

    def compute(self, reference: Records, overrun: int) -> None:
        """Run the cycle on what has come since the SYNC. ``reference`` (n,) of ``REFERENCE``;
        ``overrun`` ticks skipped before this one. Raises ValueError for another reference.
        """
        if reference is not self._reference:
            _require_rows(reference)
            self._reference = reference
        left = self._period(self.record, self.exchange, reference, overrun)
        if left >= 0:
            self._enter()

    def finish(self, t_us: int, heartbeat_until_us: int) -> None:
        """Send the voltages of this tick, and our heartbeat behind them if it is due
        and still fits before the next SYNC. Then do what they did not have to wait for.
        """
        self._pass_on(self._finish(self.record, self.exchange, t_us, heartbeat_until_us), t_us)
        self._prepare(self.record, self.exchange)

    def _pass_on(self, told: int, t_us: int) -> None:
        """Send what the compiled part wants to send and may; a voltage that may not be sent is 0 V in the next."""
        if told == 1:  # the short way, for speed
            data, can_id, flags, length, _ = _unpack(self._out, 0)
            self._send(_new_tuple(Frame, (can_id, data if length == 8 else data[:length], flags)))
            return
        if told & RESTARTED:
            self.gate.latched = ""
            self.driver.emergencies.clear()
        for at in _PLACES[: told & BLOCKED - 1]:
            data, can_id, flags, length, reason = _unpack(self._out, at)
            frame = _new_tuple(Frame, (can_id, data[:length], flags))
            if reason == 0:
                self._send(frame)
            else:
                held = self.exchange["held_against"][0] if can_id == self.driver.drive_id else self.gate.memory
                self.faults.append(self.gate.blocked(frame, self._mode[0], reason, held[0], t_us))

    def _not_restarted(self) -> None:
        self.faults.append(f"start-up after a clear: {self.failure}")

    # -- modes ------------------------------------------------------------------------------------------------------

    def _enter(self) -> None:
        if self.mode == Mode.FAULT:
            self._discard_unsent()
            row, begun_us = self.memory["row"][0], int(self.exchange["begun_us"][0])
            reason = explain(int(row["trips"]))
            emergencies = "".join(f"\n{e.told_at(begun_us)}." for e in self.driver.emergencies)
            detail = "".join(f" [{words}]" for words in (self.driver.failure, self.driver.foreign) if words)
            self.faults.append(f"at {row['t_us'] * 1e-6:.4f} s: {reason}{detail}{emergencies}{self._complaints}")

    @property
    def failure(self) -> str:
        """The driver's, and what else stands in the way."""
        return f"{self.driver.failure}{self._complaints}"

    @property
    def _complaints(self) -> str:
        return f"{complaint(self.exchange['others'][0, 0])}{self._port_complaint()}"


def part(records: Records, *names: str) -> Records:
    """The records of a field, in the place where they stand in ``records`` (1,); (1,) for one that is no array."""
    dtype, at = records.dtype, 0
    for name in names:
        inner, offset = dict(dtype.fields or {})[name][:2]
        dtype, at, shape = inner.base, at + offset, inner.shape or (1,)
    found: Records = np.ndarray(shape, dtype, records.data, at)
    return found


def _require_rows(reference: NDArray[np.void]) -> None:
    """The compiled cycle doesn't look at what it is given, so it is looked at here, once for each block of rows."""
    if reference.dtype != REFERENCE or reference.ndim != 1 or len(reference) == 0:
        raise ValueError(f"a reference is (n,) of REFERENCE with n > 0, not {reference.shape} {reference.dtype}")
    if not reference.flags.c_contiguous:
        raise ValueError("the rows of a reference must follow one another in memory (numpy.ascontiguousarray)")
