"""A stage in operation: takes commands, moves the set-points, answers. Time, commands and memory are handed in.

Called once a tick, after it: first to decide, which begins to act in the next, then to tell how things stand. It knows
no process and no clock, so it runs in lockstep as at rate.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.operate import procedures
from hil.operate.aiming import aim
from hil.operate.commands import ANSWER, SESSION, Activity, State, Verb
from hil.operate.law_change import NAME_BYTES
from hil.operate.loop import Loop
from hil.operate.path_stream import PathStream
from hil.operate.procedures import AbortedError, Lease, Operated, RefusedError, Steps
from hil.operate.reach import Reach
from hil.operate.sample_axes import PLAIN, Turn
from hil.operate.setpoints import Setpoints, rows_of
from hil.operate.settings import Settings
from pkxyz_ctrl.safety.modes import NODE_EXPECTED, Mode
from pkxyz_ctrl.trajectory.segments import Limits

Array = NDArray[np.float64]
Say = Callable[[bytes], object]
"""Takes an answer as bytes of ``ANSWER``."""

_WORDS_BYTES = ANSWER["words"].itemsize
_MODAL = frozenset({Verb.HOME, Verb.ENABLE, Verb.CLEAR, Verb.AUTO_ZERO, Verb.PATH, Verb.LAW})
"""Begun only while nothing else runs."""
_AT_ONCE = frozenset({Verb.SETTLE, Verb.LIMITS, Verb.SAMPLE, Verb.QUIET, Verb.TRIGGER})
"""Done within a tick."""
_LEAST, _MOST = 1e-12, 1e6
_SIGMAS_MOST = 10.0


class _Job(NamedTuple):
    """A command that takes time."""

    id: int
    verb: Verb
    steps: Steps


class Session:
    """``stage`` is what it works on, ``say`` where answers go, ``setpoints`` those that the loop reads; its own if not
    given.

    Targets and directions of commands, and positions in answers, are of the sample; paths, rows and ``state`` of the
    stage.
    """

    def __init__(
        self, controller: Loop, reach: Reach, settings: Settings, say: Say, law_name: str = "",
        setpoints: Setpoints | None = None,
    ) -> None:  # fmt: skip
        period_us = controller.period_us
        setpoints = setpoints or Setpoints(period_us, *rows_of(controller.law))
        self.stage = Operated(controller, setpoints, reach, settings, period_us * 1e-6, law_name.encode()[:NAME_BYTES])
        controller.settle(settings.window_m, settings.sigmas, settings.dwell_s)
        self.settings = settings
        self.state = np.zeros(1, SESSION)
        self.state["matrix"] = PLAIN
        self.now_us = 0
        self._say = say
        self._unsaid: list[bytes] = []
        self._period_us = period_us
        self._job: _Job | None = None
        self._beside: _Job | None = None  # pause, resume: besides the job that they act on
        self._lease: Lease | None = None
        self._offered: np.void | None = None
        self._jog_id = -1
        self._missed = 0
        self._known_faults = len(controller.faults)
        self._server_us: int | None = None
        self._server_says = 0

    # -- what is handed in ---------------------------------------------------------------------------------------------

    def _begin(self, command: np.void) -> None:
        """Begin a command, a record of ``COMMAND``, or refuse it."""
        try:
            verb = Verb(int(command["verb"]))
        except ValueError:
            self._answer(int(command["id"]), 0, State.REFUSED, f"there is no verb {int(command['verb'])}")
            return
        try:
            self._take(int(command["id"]), verb, command)
        except RefusedError as refused:
            self._answer(int(command["id"]), verb, State.REFUSED, str(refused))

    def take_rows(self, number: int, first: int, motion: Array, output: NDArray[np.int32]) -> None:
        """Rows (n, 9) of the path that is followed, and their trigger bits (n,); others are left aside."""
        if self.stage.path is not None:
            self.stage.path.take(number, first, motion, output)

    def offer(self, offered: np.void) -> None:
        """A law, a record of ``law_change.OFFER``, for a command that will name its number."""
        self._offered = offered

    @property
    def wants_rows(self) -> bool:
        """Whether there is a path that one more block of rows fits into."""
        path, setpoints = self.stage.path, self.stage.setpoints
        return path is not None and path.has_room(int(setpoints.path_row) if setpoints.follows(path) else 0)

    def server_says(self, count: int) -> None:
        """The server's sign of life: a number that is another one each time."""
        if count != self._server_says:
            self._server_says, self._server_us = count, self.now_us

    # -- once a tick ---------------------------------------------------------------------------------------------------

    def decide(self, row: np.void, commands: Iterable[np.void] = (), missed: int = 0) -> None:
        """A tick is over, and this is its row of ``ROW``; ``commands``, records of ``COMMAND``, have come since the
        last call, and so many more periods have passed that nobody said so of. On return the set-points of the next
        tick are ready.
        """
        stage, controller = self.stage, self.stage.controller
        self.now_us += self._period_us * (1 + int(row["overrun"]) + missed)
        stage.passed += 1 + missed
        if len(controller.faults) > self._known_faults:
            self._note_fault("\n".join(controller.faults[self._known_faults :]))
        self._look_at_leases()
        self._job = self._step(self._job)
        self._beside = self._step(self._beside)
        if stage.mode == Mode.TRACKING:
            stage.setpoints.advance(int(controller.memory["reference_tick"][0]))
        for command in commands:
            self._begin(command)

    # -- commands ------------------------------------------------------------------------------------------------------

    def _take(self, command_id: int, verb: Verb, command: np.void) -> None:
        running = self._job
        if verb is Verb.RELEASE:
            self.stage.controller.release()
            self._answer(
                command_id, verb, State.DONE, "the stage is led down and the combs go to 0 V; clear when ready"
            )
            return
        if verb in _AT_ONCE:
            self._answer(command_id, verb, State.DONE, self._set(verb, command))
            return
        if verb is Verb.JOG and self._renewed(command):
            return
        if verb in _MODAL and running is not None:
            raise RefusedError(f"{running.verb.name} (command {running.id}) is running: wait for it, or abort it first")
        if verb in (Verb.MOVE, Verb.JOG) and running is not None and running.verb not in (Verb.MOVE, Verb.JOG):
            raise RefusedError(f"{running.verb.name} (command {running.id}) is running: abort it, or wait for its end")
        job = _Job(command_id, verb, self._steps_of(verb, command))
        begun = self._begun(job)  # raises where it is refused: then what runs goes on
        taken = f"{verb.name} (command {command_id}) has taken its place"
        self._end_beside(taken)
        if verb in (Verb.PAUSE, Verb.RESUME):
            self._beside = begun
            return
        if running is not None:
            self._end(running, taken)
        self._job = begun

    def _steps_of(self, verb: Verb, command: np.void) -> Steps:
        stage = self.stage
        if verb is Verb.MOVE:
            return procedures.move(stage, self._target(command), self._limits(command))
        if verb is Verb.JOG:
            direction = np.array(command["target_m"])  # of the sample
            if not np.isfinite(direction).all() or np.count_nonzero(direction) != 1:
                raise RefusedError("a jog goes along one axis: give a direction of +1 or -1 for it, 0 for the others")
            self._lease = Lease(self.now_us + round(self.settings.lease_s * 1e6))
            return procedures.jog(stage, direction, self._limits(command), self._lease)
        if verb is Verb.PATH:
            ends = command["start_m"].copy(), command["target_m"].copy()
            return procedures.follow(stage, PathStream(int(command["path"]), int(command["rows"]), *ends, stage.reach))
        if verb is Verb.LAW:
            return self._change_law(command)
        if verb in (Verb.STOP, Verb.ABORT):
            return procedures.halt(stage, on_path=verb is Verb.ABORT)
        plain = {
            Verb.HOME: procedures.home, Verb.ENABLE: procedures.enable, Verb.DISABLE: procedures.disable,
            Verb.PARK: procedures.park, Verb.CLEAR: procedures.clear, Verb.AUTO_ZERO: procedures.auto_zero,
            Verb.PAUSE: procedures.pause, Verb.RESUME: procedures.resume,
        }  # fmt: skip
        return plain[verb](stage)

    def _target(self, command: np.void) -> Array:
        asked, target, turn = command["target_m"], self.stage.setpoints.target_m, self.stage.reach.turn
        if command["relative"]:
            return np.asarray(target + turn.way_to_stage(np.where(np.isnan(asked), 0.0, asked)))
        return np.asarray(turn.to_stage(np.where(np.isnan(asked), turn.to_sample(target), asked)))

    def _limits(self, command: np.void) -> Limits:
        """Those of the command, else those in force."""
        names = ("velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3")
        asked = [float(command[name]) for name in names]
        for name, value in zip(names, asked, strict=True):
            if value != 0.0 and not _LEAST <= value <= _MOST:
                raise RefusedError(f"{name} is {value:g}, limits {_LEAST:g} to {_MOST:g}")
        return Limits(*(a if a != 0.0 else own for a, own in zip(asked, self.settings.limits, strict=True)))

    def _set(self, verb: Verb, command: np.void) -> str:
        if verb is Verb.LIMITS:
            self.settings.limits = self._limits(command)
            v, a, j = self.settings.limits
            return f"moves that name none: {v:g} m/s, {a:g} m/s2, {j:g} m/s3"
        if verb is Verb.SAMPLE:
            return self._take_sample(command)
        if verb is Verb.QUIET:
            self.stage.controller.hold_quietly(bool(command["on"]))
            return "holds are quiet: less noise, less rejection" if command["on"] else "holds are as stiff as moves"
        if verb is Verb.TRIGGER:
            return aim(self.stage.controller, command)
        window_m, dwell_s, sigmas = (float(command[name]) for name in ("window_m", "dwell_s", "sigmas"))
        if not 0.0 <= sigmas <= _SIGMAS_MOST:
            raise RefusedError(f"sigmas {sigmas:g}, limits 0 to {_SIGMAS_MOST:g}")
        if not 0.1e-9 <= window_m <= 10e-6 or not 0.0 <= dwell_s <= 10.0:
            raise RefusedError(f"window {window_m:g} m, limits 1e-10 to 1e-05 m; dwell {dwell_s:g} s, limits 0 to 10 s")
        self.settings.window_m, self.settings.dwell_s, self.settings.sigmas = window_m, dwell_s, sigmas
        self.stage.controller.settle(window_m, sigmas, dwell_s)
        of_it = f", {sigmas:g} standard deviations of the estimate included" if sigmas else ""
        return f"in position within {window_m * 1e9:g} nm for {dwell_s * 1e3:g} ms{of_it}"

    def _take_sample(self, command: np.void) -> str:
        try:
            turn = Turn(command["matrix"])
        except ValueError as error:
            raise RefusedError(str(error)) from None
        self.stage.reach.turn = turn
        self.state["matrix"] = turn.matrix
        return "the stage's own coordinates" if turn.is_plain else "coordinates of the sample, from now on"

    def _change_law(self, command: np.void) -> Steps:
        stage, offered = self.stage, self._offered
        if offered is None or int(offered["number"]) != int(command["law"]):
            raise RefusedError("that law did not come: ask again")
        if not (stage.mode == Mode.IDLE or self._activity() is Activity.HOLDING):
            raise RefusedError(f"a law is changed while the stage holds or is off, and it is {self._activity().name}")
        return procedures.change_law(self.stage, offered)

    def _renewed(self, command: np.void) -> bool:
        """Whether this only says again, or ends, the jog that runs."""
        job, lease = self._job, self._lease
        direction = command["target_m"]
        is_end = not direction.any()
        is_again, self._jog_id = int(command["id"]) == self._jog_id, int(command["id"])
        if job is None or job.verb is not Verb.JOG or lease is None:
            if is_end:
                self._answer(int(command["id"]), Verb.JOG, State.DONE, "no jog runs")
            return is_end or is_again  # what has ended already is not begun again by being renewed
        if is_end:
            lease.end("the jog was ended")
            self._answer(int(command["id"]), Verb.JOG, State.DONE, "the jog ends")
            return True
        if int(command["id"]) == job.id:
            lease.until_us = self.now_us + round(self.settings.lease_s * 1e6)
            return True
        return False

    # -- jobs ----------------------------------------------------------------------------------------------------------

    def _begun(self, job: _Job) -> _Job | None:
        """The job after its first step. Raises ``RefusedError``."""
        try:
            next(job.steps)
        except StopIteration as end:
            self._answer(job.id, job.verb, State.DONE, str(end.value))
            return None
        except AbortedError as error:
            self._answer(job.id, job.verb, State.ABORTED, str(error))
            return None
        self._answer(job.id, job.verb, State.RUNNING, "")
        return job

    def _step(self, job: _Job | None) -> _Job | None:
        if job is None:
            return None
        try:
            next(job.steps)
        except StopIteration as end:
            self._answer(job.id, job.verb, State.DONE, str(end.value))
        except (AbortedError, RefusedError) as error:
            self._answer(job.id, job.verb, State.ABORTED, str(error))
        else:
            if self.stage.said:
                self._answer(job.id, job.verb, State.RUNNING, self.stage.said)
                self.stage.said = ""
            return job
        if job.verb is Verb.PATH:
            self._forget_path()
        return None

    def _end(self, job: _Job, why: str) -> None:
        job.steps.close()
        self._answer(job.id, job.verb, State.ABORTED, why)
        if job.verb is Verb.PATH:
            self.stage.path = None

    def _end_beside(self, why: str) -> None:
        if self._beside is not None:
            self._end(self._beside, why)
            self._beside = None

    def _forget_path(self) -> None:
        """A path that ended, or could not be followed: stand where it stands."""
        self.stage.path = None
        if self.stage.is_driven and self.stage.setpoints.stands_on_path:
            self.stage.setpoints.leave_path()

    # -- what is looked at ---------------------------------------------------------------------------------------------

    def _note_fault(self, words: str) -> None:
        self._known_faults = len(self.stage.controller.faults)
        for job in (self._job, self._beside):
            if job is not None and job.verb is not Verb.CLEAR:
                self._end(job, words.splitlines()[0])
        if self._job is None or self._job.verb is not Verb.CLEAR:
            self._job = None
        self._beside = None
        self._answer(0, 0, State.ABORTED, words)

    def _look_at_leases(self) -> None:
        if self._lease is not None:
            self._lease.look(self.now_us)
        if self._server_us is None or self.now_us - self._server_us <= self.settings.silence_s * 1e6:
            return
        self._server_us = None  # once; its next sign of life makes it a server again
        moving = not self.stage.setpoints.has_arrived or self._job is not None
        if not self.stage.is_driven or not (moving or self.settings.on_silence == "park"):
            return
        if self._job is not None:
            self._end(self._job, "the server has fallen silent")
        self._end_beside("the server has fallen silent")
        self._job = _Job(0, Verb.ABORT, self._halted_by_silence())

    def _halted_by_silence(self) -> Steps:
        words = yield from procedures.halt(self.stage, on_path=True)
        if self.settings.on_silence == "park":
            words = yield from procedures.park(self.stage)
        return f"the server has fallen silent: {words}"

    # -- what is told --------------------------------------------------------------------------------------------------

    def tell(self) -> None:
        """Say what is to be answered, and write into ``state`` how things stand."""
        for answer in self._unsaid:
            self._say(answer)
        self._unsaid.clear()
        state, stage = self.state, self.stage
        setpoints, path, position = stage.setpoints, stage.path, stage.controller.outputs["position"]
        state["activity"] = int(self._activity())
        state["in_position"] = stage.is_in_position and stage.is_driven
        state["homed"] = stage.is_homed
        state["running_id"] = self._job.id if self._job is not None else 0
        state["law"] = stage.law_name
        state["target_m"], state["uncertainty_m"] = setpoints.target_m, position["uncertainty_m"]
        on_path = setpoints.follows(path)
        state["path_row"] = setpoints.path_row if on_path else np.nan
        state["progress"] = setpoints.path_row / max(1, path.rows) if on_path and path is not None else 0.0
        missed = stage.controller.missed_ticks
        state["missed"] += (missed - self._missed) * bool(NODE_EXPECTED[stage.mode])  # else nothing waits for a tick
        self._missed = missed

    def _activity(self) -> Activity:
        stage, setpoints = self.stage, self.stage.setpoints
        by_mode: dict[int, Activity] = {
            Mode.BOOT: Activity.STARTING, Mode.PRE_OPERATIONAL: Activity.STARTING, Mode.IDLE: Activity.OFF,
            Mode.HOMING: Activity.HOMING, Mode.FAULT: Activity.FAULT, Mode.LANDING: Activity.STOPPING,
        }  # fmt: skip
        if stage.mode in by_mode:
            return by_mode[stage.mode]
        if setpoints.has_arrived:
            return Activity.HOLDING
        if setpoints.stands_on_path:
            return Activity.PAUSED
        verb = self._job.verb if self._job is not None else None
        if setpoints.is_stopping or verb in (Verb.STOP, Verb.ABORT):
            return Activity.STOPPING
        if setpoints.follows(stage.path):
            return Activity.SCANNING
        return Activity.JOGGING if verb is Verb.JOG else Activity.MOVING

    def _answer(self, command_id: int, verb: int, state: State, words: str) -> None:
        said = words.encode()[:_WORDS_BYTES]
        self._unsaid.append(np.array([(command_id, verb, state, self.now_us, said)], ANSWER).tobytes())
