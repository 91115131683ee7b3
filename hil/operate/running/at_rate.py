"""The loop of a stage in operation, at the machine's clock, in a process of its own.

Commands and telemetry cross in shared memory; whatever becomes of those at its other end, no tick waits for them.
"""

import os
from collections.abc import Callable

import numpy as np

from hil.bus.frame_time import frame_duration_ns
from hil.lanes.ending import Ended, Ending
from hil.lanes.setup import Setup
from hil.lanes.wall import WallRig, require_real_bus
from hil.operate.commands import COMMAND, PATH_BLOCK, TICK, Verb, new_command
from hil.operate.law_change import OFFER
from hil.operate.loop import Loop
from hil.operate.memory import StageMemory
from hil.operate.path_stream import PathStream
from hil.operate.reach import Reach
from hil.operate.session import Session
from hil.operate.setpoints import Setpoints
from hil.operate.settings import Settings
from hil.operate.tick_frames import TickFrames
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.client import place
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory.check import DriveLimits

KEPT_S = 60.0
"""Of telemetry that stays in the memory."""
_COMMANDS_A_TICK, _BLOCKS_AT_ONCE = 4, 4


class Counted:
    """``TakesTicks`` that counts frames and keeps those of the tick; the rows go to the memory."""

    def __init__(self, can: CanConfig) -> None:
        self.frames = 0
        self.wire_ns = 0
        self.of_tick = TickFrames()
        self._nominal = can.nominal_bitrate_bit_per_s
        self._data = can.data_bitrate_bit_per_s or can.nominal_bitrate_bit_per_s
        self._duration_ns: dict[int, int] = {}

    def frame(self, frame: Frame, t_us: int) -> None:
        self.frames += 1
        self.of_tick.note(frame, t_us)
        length = len(frame.data)
        if length not in self._duration_ns:
            self._duration_ns[length] = frame_duration_ns(frame, self._nominal, self._data)
        self.wire_ns += self._duration_ns[length]

    def row(self, row: memoryview) -> None:
        """Nobody's here."""


class OperatedLoop:
    """What joins a session to the memory, tick by tick. ``stood_us``: how long time has stood still."""

    def __init__(self, session: Session, memory: StageMemory, counted: Counted, stood_us: Callable[[], int]) -> None:
        self._session, self._counted, self._stood_us = session, counted, stood_us
        self._ticks, self._frames = memory.writer("ticks"), memory.writer("frames")
        self._commands = memory.reader("commands", from_start=True)  # what was asked while the amplifier started, too
        self._path = memory.reader("path", from_start=True)
        self._laws = memory.reader("laws")
        self._head = memory.head
        self._stop_id = 0
        self._tick = np.zeros(1, TICK)
        self._tick_bytes = self._tick.view(np.uint8).data

    def after(self, tick: int) -> None:
        """A tick of Python's loop is over."""
        self.step()
        self.tell(self._session.stage.controller.memory["row"].view(np.uint8).data)

    def step(self, missed: int = 0) -> None:
        """The session goes on, after a tick and so many more that it missed."""
        session = self._session
        session.server_says(int(self._head["server"][0]))
        for _ in range(1 + min(missed, _BLOCKS_AT_ONCE)):
            if session.wants_rows:
                self._take_rows()
        session.decide(session.stage.controller.memory["row"][0], self._come(), missed)

    def tell(self, row: bytes | memoryview) -> None:
        """Write down a tick's record of ``ROW``, with its frames and what the session says now."""
        self._session.tell()
        state = self._session.state
        state["commands"] = self._commands.next - 1
        state["stood_us"] = self._stood_us()
        state["frames"], state["wire_ns"] = self._counted.frames, self._counted.wire_ns
        self._tick_bytes[: ROW.itemsize] = row
        self._tick["session"] = state
        self._frames.write(self._counted.of_tick.taken(int(self._tick["row"]["tick"][0])))
        self._ticks.write(self._tick_bytes)

    def _come(self) -> list[np.void]:
        """Commands that have come; a stop that anyone asked for is the first of them."""
        commands: list[np.void] = []
        if (stop_id := int(self._head["stop"][0])) != self._stop_id:
            self._stop_id = stop_id
            commands.append(new_command(Verb.STOP, stop_id)[0])
        while len(commands) < _COMMANDS_A_TICK and (command := self._commands.read()) is not None:
            commands.append(np.frombuffer(command, COMMAND)[0])
            if commands[-1]["verb"] == Verb.LAW:
                self._take_law()
        return commands

    def _take_law(self) -> None:
        while (offered := self._laws.read()) is not None:
            self._session.offer(np.frombuffer(offered, OFFER)[0])

    def _take_rows(self) -> None:
        block = self._path.read()
        if block is not None:
            rows = np.frombuffer(block, PATH_BLOCK)[0]
            count = min(int(rows["count"]), len(rows["motion"]))
            self._session.take_rows(
                int(rows["path"]), int(rows["first"]), rows["motion"][:count], rows["output"][:count]
            )


def operate(setup: Setup, settings: Settings, name: str, files: dict[str, str], say: Callable[[str], object]) -> int:
    """Run the loop until SIGINT or SIGTERM; returns the signal. At its end the combs are at 0 V.

    ``setup`` without automatic start; ``files``: by which names or files others find what it consists of.
    Raises ``ConfigError``, ``StartUpError``, and ``OSError`` for the memory.
    """
    with Ending() as ending:
        counted = Counted(require_real_bus(setup.bus))
        rig = WallRig(setup, counted, ending)
        memory = StageMemory.made(name, round(KEPT_S / setup.bus.period_s))
        try:
            session = session_of(setup, settings, rig.controller, memory)
            rig.wait_for_others(say)
            place.write(name, "loop", description(setup, settings, memory, files))
            say(rig.go_real_time())
            rig.start(say)
            operated = OperatedLoop(session, memory, counted, lambda: rig.clock.stood_us)
            rig.operate(session.stage.setpoints, operated.after)
        except Ended as end:
            return end.signal_number
        finally:
            try:
                rig.close()
            finally:
                place.forget(name, "loop")
                memory.remove()
    return 0


def session_of(
    setup: Setup, settings: Settings, loop: Loop, memory: StageMemory, setpoints: Setpoints | None = None
) -> Session:
    """One that is ready, and answers into the memory."""
    reach = Reach(Stage(setup.stage), DriveLimits.of(setup.controller, setup.bus))
    rehearse(reach, settings)
    return Session(loop, reach, settings, memory.writer("answers").write, setup.controller.name, setpoints)


def rehearse(reach: Reach, settings: Settings) -> None:
    """Look, move, pause, follow, refuse once without a stage: what is loaded at its first use costs a tick some ms."""
    setpoints = Setpoints(500, 1, 20)
    start, near_m = np.zeros(3), np.array([0.0, 0.0, 1e-6])
    for position in (near_m, np.full(3, 1.0), np.full(3, 1e-3)):
        reach.target_refusal(position)
    reach.farthest(near_m, 0, 1.0)
    path = PathStream(1, 2, start, start, reach)
    path.take(1, 0, np.zeros((2, 9)), np.zeros(2, np.int32))
    steps: tuple[Callable[[], object], ...] = (
        lambda: setpoints.go(near_m, settings.limits, reach.motion_refusal), setpoints.stop_on_path, setpoints.go_on,
        setpoints.leave_path, lambda: setpoints.brake(settings.limits), lambda: setpoints.follow(path, start),
    )  # fmt: skip
    for step in steps:
        step()
        for row in range(setpoints.row + 1, setpoints.row + 100):
            setpoints.advance(row)


def description(setup: Setup, settings: Settings, memory: StageMemory, files: dict[str, str]) -> dict[str, object]:
    """What others need to know of the loop."""
    return {
        "pid": os.getpid(), "memory": str(memory.path), "files": files, "stage": setup.stage.name,
        "controller": setup.controller.name, "bus": setup.bus.name, "period_us": setup.bus.period_us,
        "voltage_max_v": setup.controller.limits.voltage_max_v, "on_silence": settings.on_silence,
        "interface": setup.bus.can.interface if setup.bus.can is not None else "",
        "limits": list(settings.limits), "window_m": settings.window_m, "dwell_s": settings.dwell_s,
        "middle_m": [float(v) for v in setup.law["tick"]["estimator"]["operating_point_m"][0]],
    }  # fmt: skip
