"""A stage in operation in lockstep: a script, resumed after each tick, gives commands and sees what comes of them."""

import dataclasses
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
from loop_rig import setup

from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.operate.commands import ANSWER, FINAL, PATH_ROWS, State, Verb, new_command
from hil.operate.reach import Reach
from hil.operate.session import Session
from hil.operate.settings import Settings
from pkxyz_ctrl.loop.row import ROW, TRUTH_FIELDS
from pkxyz_ctrl.loop.runtime import run, start
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Raster, Trajectory
from pkxyz_ctrl.trajectory.check import DriveLimits
from pkxyz_ctrl.trajectory.segments import Limits

Script = Generator[None, None, None]
MIDDLE_M = (0.0, 0.0, 18e-6)
SECONDS_AT_MOST = 20.0
PERIOD_S = 200e-6
_LIMITS = Limits(0.5e-3, 0.5, 300.0)


class _OverError(Exception):
    pass


class OperatedRig:
    """``rows``: all ticks; ``answers``: (id, state, words) as they came."""

    def __init__(self, of: Setup | None = None, settings: Settings | None = None) -> None:
        self.setup = dataclasses.replace(of or setup(), autostart=False)
        self.lockstep = LockstepRig(self.setup)
        self.controller = self.lockstep.controller
        self.period_us = self.setup.bus.period_us
        self.reach = Reach(Stage(self.setup.stage), DriveLimits.of(self.setup.controller, self.setup.bus))
        self.answers: list[tuple[int, State, str]] = []
        self.session = Session(self.controller, self.reach, settings or Settings(), self._note)
        self.rows: list[Any] = []
        self._id = 0
        self._given: list[Any] = []
        self.every_tick: list[Callable[[], object]] = []

    def _note(self, answer: bytes) -> None:
        record = np.frombuffer(answer, ANSWER)[0]
        self.answers.append((int(record["id"]), State(int(record["state"])), record["words"].decode()))

    def after_tick(self, row: np.void) -> None:
        """The session's turn."""
        self.session.decide(row, self._given)
        self.session.tell()
        self._given.clear()

    def play(self, script: Script) -> np.ndarray:
        """Run until the script ends; returns the rows of all ticks."""

        def after(tick: int) -> None:
            row = self.controller.memory["row"][0]
            plant = self.lockstep.plant
            if not plant.was_sampled:
                plant.look(self.lockstep.clock.now_us)
            plant.was_sampled = False
            for name, *_ in TRUTH_FIELDS:
                row[name] = plant.record[name][0]
            for each in self.every_tick:
                each()
            try:
                next(script)
            except StopIteration:
                raise _OverError from None
            self.after_tick(row)
            self.rows.append(row.copy())

        self.lockstep.node.power_on()
        start(self.lockstep.clock, self.lockstep.port, self.controller)
        ticks = round(SECONDS_AT_MOST * 1e6 / self.period_us)
        try:
            run(self.lockstep.clock, self.lockstep.port, self.controller, self.session.stage.setpoints, ticks, after)
        except _OverError:
            pass
        else:
            raise AssertionError(f"the script did not end in {SECONDS_AT_MOST} s; answers: {self.answers[-3:]}")
        return np.array([row.tolist() for row in self.rows], ROW)

    # -- what scripts say ---------------------------------------------------------------------------------------------

    def give(self, verb: Verb, *, same_id: int | None = None, **fields: Any) -> int:
        """Give a command; returns its id. Acts in the next tick."""
        self._id += 1 if same_id is None else 0
        command = new_command(verb, self._id if same_id is None else same_id)
        for name, value in fields.items():
            command[name] = value
        self._given.append(command[0])
        return int(command["id"][0])

    def state_of(self, command_id: int) -> State | None:
        states = [state for n, state, _ in self.answers if n == command_id]
        return states[-1] if states else None

    def words_of(self, command_id: int) -> str:
        return [words for n, _, words in self.answers if n == command_id][-1]

    def until_final(self, command_id: int) -> Generator[None, None, State]:
        while (state := self.state_of(command_id)) not in FINAL:
            yield
        assert state is not None
        return state

    def do(self, verb: Verb, **fields: Any) -> Generator[None, None, State]:
        """Give a command and wait for its end."""
        return (yield from self.until_final(self.give(verb, **fields)))

    def switched_on(self) -> Script:
        """Homed, enabled, in the middle of the workspace."""
        for verb, fields in ((Verb.HOME, {}), (Verb.ENABLE, {}), (Verb.MOVE, {"target_m": MIDDLE_M})):
            state = yield from self.do(verb, **fields)
            assert state is State.DONE, self.answers[-1]

    def wait_s(self, seconds: float) -> Script:
        for _ in range(round(seconds * 1e6 / self.period_us)):
            yield


class Feeder:
    """Streams rows (n, 9) of a path while a session has room for them; ``stopped``: as if it had been killed."""

    def __init__(self, rig: OperatedRig, number: int, rows: np.ndarray) -> None:
        self._session, self._number, self._rows, self._at = rig.session, number, rows, 0
        self.stopped = False
        rig.every_tick.append(self._feed)

    def _feed(self) -> None:
        if not self.stopped and self._at < len(self._rows) and self._session.wants_rows:
            rows = self._rows[self._at : self._at + PATH_ROWS]
            self._session.take_rows(self._number, self._at, rows, np.zeros(len(rows), np.int32))
            self._at += PATH_ROWS


def tracked(rows: np.ndarray) -> np.ndarray:
    return rows[rows["mode"] == Mode.TRACKING]


def require_smooth(rows: np.ndarray) -> None:
    """Set-points keep velocity, acceleration and jerk of every axis, whatever was asked."""
    reference = tracked(rows)["reference_m"]
    for order, most in zip((1, 2, 3), _LIMITS, strict=True):
        differences = np.diff(reference, order, axis=0) / PERIOD_S**order
        assert np.abs(differences).max() <= most * 1.001, order


def raster_rows(period_us: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """A small raster about the middle, as rows, and its first point."""
    scan = Raster(
        kind="raster", line_length_m=2e-6, lines=20, line_pitch_m=0.1e-6, layers=1, layer_pitch_m=0.5e-6,
        line_rate_hz=60.0, velocity_max_m_per_s=0.5e-3, acceleration_max_m_per_s2=0.5, jerk_max_m_per_s3=300.0,
    )  # fmt: skip
    trajectory = Trajectory([scan])
    rows = trajectory.sample(0, trajectory.duration_us // period_us + 2, period_us)
    rows[:, 0:3] += MIDDLE_M
    return rows, rows[0, 0:3]
