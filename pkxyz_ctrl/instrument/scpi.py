"""The stage as an instrument that speaks SCPI: what each line asks of the client of ``pkxyz serve``, and answers.

Lengths in m, times in s, as everywhere. A line may hold several commands, separated by semicolons; a header that begins
with a colon starts at the root, others in the subsystem of the one before them.
"""

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable
from importlib.metadata import version
from typing import Any, Final, NamedTuple

import numpy as np

from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.client.reply import AbortedError, Command, NoStageError, RefusedError, StageError
from pkxyz_ctrl.client.stage import Axis
from pkxyz_ctrl.instrument.axis_moves import AXES, AxisMoves, MotionLimits
from pkxyz_ctrl.instrument.scpi_errors import ErrorQueue, ScpiError

Answer = str | bytes | None
LINE_MOST: Final = 4096
"""Bytes of a line from a client."""
CAPTURE_MOST_S: Final = 10.0
_TAKEN_UP: Final = "has taken its place"
"""So a command ends for which another one came, or a stop."""
_FIELDS: Final = ("reference_m", "estimate_m", "voltage_v")


class Header(NamedTuple):
    """A command's header: long and short form, whether it ends with an axis, and what it does."""

    form: str
    about: str


HEADERS: Final[dict[str, Header]] = {
    "idn": Header("*IDN?", "who it is: maker, stage, controller, version"),
    "rst": Header("*RST", "stop, the limits of moves as at the start; the stage stays where it is"),
    "cls": Header("*CLS", "forget the errors"),
    "opc": Header("*OPC?", "1 once all that was asked is done"),
    "wai": Header("*WAI", "what follows waits for what was asked"),
    "error": Header("SYSTem:ERRor[:NEXT]?", "the oldest error: number, words"),
    "count": Header("SYSTem:ERRor:COUNt?", "how many there are"),
    "version": Header("SYSTem:VERSion?", "of SCPI"),
    "control": Header("SYSTem:CONTrol", "1 takes control, 0 gives it back; what moves takes it by itself"),
    "state": Header("STATe?", "what the stage is doing, in a word"),
    "words": Header("STATe:WORDs?", "the same in words, with the last fault"),
    "in_position": Header("STATe:POSition?", "1 if it is in position"),
    "position": Header("POSition[:ACTual]? [X|Y|Z]", "where it is, in m"),
    "target": Header("POSition:TARGet? [X|Y|Z]", "where its motion ends, in m"),
    "limits": Header("POSition:LIMits? X|Y|Z", "least and largest target that the combs can hold, in m"),
    "move": Header("MOVE X|Y|Z,<m>[,X|Y|Z,<m>...]", "go there; does not wait"),
    "by": Header("MOVE:RELative X|Y|Z,<m>", "go by a way; does not wait"),
    "velocity": Header("MOVE:VELocity <m/s>", "of moves from now on; with ? tells it"),
    "stop": Header("STOP", "stop by the shortest way; needs no control"),
    "release": Header("RELease", "0 V at once; needs no control"),
    "home": Header("HOME", "measure the sense offsets at rest"),
    "enable": Header("ENABle", "close the loop"),
    "disable": Header("DISable", "open it: 0 V"),
    "park": Header("PARK", "go to rest, then 0 V"),
    "clear": Header("CLEar", "forget the fault"),
    "scan": Header("SCAN <name>", "follow the path of a shipped scenario"),
    "capture": Header("CAPTure? <s>", "set-points, positions, voltages: 9 doubles a tick, as a block"),
}
"""All that it understands."""


class ScpiSession:
    """One client's. ``answer_to`` takes a line and returns what is sent back, or None."""

    def __init__(self, moves: AxisMoves) -> None:
        self.errors = ErrorQueue()
        self._moves, self._stage = moves, moves.stage
        self._running: set[asyncio.Task[None]] = set()
        self._velocity_m_per_s = self._motion_limits.velocity_m_per_s
        self._verbs = _forms()

    @property
    def _motion_limits(self) -> MotionLimits:
        return MotionLimits(*self._stage.description["limits"])

    async def answer_to(self, line: str) -> Answer:
        """What is sent back for a line. Raises ``NoStageError``."""
        answers: list[str | bytes] = []
        subsystem = ""
        for each in filter(None, (part.strip() for part in line.split(";"))):
            head, _, rest = each.partition(" ")
            if not head.startswith(("*", ":")) and subsystem and self._verbs.get(_plain(subsystem + head)):
                head = subsystem + head
            if not head.startswith("*"):
                subsystem = head.lstrip(":").rpartition(":")[0] + ":" if ":" in head.lstrip(":") else ""
            try:
                answer = await self._do(head, [p.strip() for p in rest.split(",")] if rest.strip() else [])
            except ScpiError as error:
                self.errors.put(error)
            else:
                answers += [] if answer is None else [answer]
        if any(isinstance(answer, bytes) for answer in answers):
            return b";".join(a if isinstance(a, bytes) else a.encode("ascii") for a in answers)
        return ";".join(str(answer) for answer in answers) if answers else None

    async def end(self) -> None:
        """The client is gone: what it asked goes on in the stage, and nobody waits for it."""
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)

    async def _do(self, head: str, parameters: list[str]) -> Answer:
        verb = self._verbs.get(_plain(head))
        if verb is None:
            raise ScpiError(-113, head)
        try:
            do: Callable[[list[str]], Awaitable[Answer]] = getattr(self, f"_{verb}")
            return await do(parameters)
        except NoStageError:
            raise
        except StageError as error:
            raise _said(error) from None

    # -- common commands, system ---------------------------------------------------------------------------------------

    async def _idn(self, parameters: list[str]) -> str:
        _no_more_than(parameters, 0)
        told = self._stage.description
        return f"pkxyz_ctrl,{told['stage']},{told['controller']},{version('pkxyz-ctrl')}".replace(" ", "_")

    async def _rst(self, parameters: list[str]) -> None:
        _no_more_than(parameters, 0)
        await self._stop(parameters)
        self._velocity_m_per_s = self._motion_limits.velocity_m_per_s

    async def _cls(self, parameters: list[str]) -> None:
        _no_more_than(parameters, 0)
        self.errors.clear()

    async def _opc(self, parameters: list[str]) -> str:
        await self._wai(parameters)
        return "1"

    async def _wai(self, parameters: list[str]) -> None:
        _no_more_than(parameters, 0)
        await asyncio.gather(*self._running)

    async def _error(self, parameters: list[str]) -> str:
        _no_more_than(parameters, 0)
        return self.errors.take()

    async def _count(self, parameters: list[str]) -> str:
        return str(len(self.errors))

    async def _version(self, parameters: list[str]) -> str:
        return "1999.0"

    async def _control(self, parameters: list[str]) -> None:
        await (self._moves.take_control() if _number(parameters, 0) else self._moves.give_control())

    # -- what is so ----------------------------------------------------------------------------------------------------

    async def _state(self, parameters: list[str]) -> str:
        return self._stage.status.activity

    async def _words(self, parameters: list[str]) -> str:
        status = self._stage.status
        return '"' + (status.last_fault or status.words).replace('"', "'").replace("\n", " ") + '"'

    async def _in_position(self, parameters: list[str]) -> str:
        return str(int((await self._stage.next_status()).in_position))

    async def _position(self, parameters: list[str]) -> str:
        return _axes_of((await self._stage.next_status()).position_m, parameters)

    async def _target(self, parameters: list[str]) -> str:
        return _axes_of((await self._stage.next_status()).target_m, parameters)

    async def _limits(self, parameters: list[str]) -> str:
        if len(parameters) != 1:
            raise ScpiError(-109, "an axis: X, Y or Z")
        return ",".join(_text(v) for v in (await self._stage.next_status()).range_m[AXES.index(_axis(parameters[0]))])

    # -- what moves ----------------------------------------------------------------------------------------------------

    async def _move(self, parameters: list[str]) -> None:
        if not parameters or len(parameters) % 2:
            raise ScpiError(-109, "an axis and a target in m: MOVE X,1e-6")
        targets = {_axis(axis): _number(parameters, 2 * n + 1) for n, axis in enumerate(parameters[::2])}
        await self._moves.take_control()
        limits = self._motion_limits._replace(velocity_m_per_s=self._velocity_m_per_s)
        await self._begin(self._stage.move_to(**_named(targets), **limits._asdict(), wait=False))

    async def _by(self, parameters: list[str]) -> None:
        _no_more_than(parameters, 2)
        way = {_axis(parameters[0] if parameters else ""): _number(parameters, 1)}
        await self._moves.take_control()
        limits = self._motion_limits._replace(velocity_m_per_s=self._velocity_m_per_s)
        await self._begin(self._stage.move_by(**_named(way), **limits._asdict(), wait=False))

    async def _begin(self, asking: Awaitable[Command]) -> None:
        """What is refused is an error of the line itself; the end is waited for by *OPC?."""
        task = asyncio.create_task(self._arrive(await asking))
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    async def _arrive(self, command: Command) -> None:
        try:
            await self._stage.ended(command)
        except AbortedError as error:
            if _TAKEN_UP not in str(error):
                self.errors.put(_said(error))

    async def _velocity(self, parameters: list[str]) -> str | None:
        if not parameters:
            return _text(self._velocity_m_per_s)
        velocity, most = _number(parameters, 0), self._motion_limits.velocity_m_per_s
        if not 0.0 < velocity <= most:
            raise ScpiError(-222, f"velocity {velocity:g} m/s, limits 0 to {most:g} m/s")
        self._velocity_m_per_s = velocity
        return None

    async def _stop(self, parameters: list[str]) -> None:
        _no_more_than(parameters, 0)
        await self._moves.stand_still()

    async def _release(self, parameters: list[str]) -> None:
        await self._stage.release()

    async def _scan(self, parameters: list[str]) -> None:
        if len(parameters) != 1:
            raise ScpiError(-109, "the name of a shipped scenario")
        await self._moves.take_control()
        await self._begin(self._stage.follow(parameters[0].strip("\"'"), wait=False))

    async def _plain_verb(self, verb: str, parameters: list[str]) -> None:
        _no_more_than(parameters, 0)
        await self._moves.take_control()
        await getattr(self._stage, verb)()

    async def _home(self, parameters: list[str]) -> None:
        await self._plain_verb("home", parameters)

    async def _enable(self, parameters: list[str]) -> None:
        await self._plain_verb("enable", parameters)

    async def _disable(self, parameters: list[str]) -> None:
        await self._plain_verb("disable", parameters)

    async def _park(self, parameters: list[str]) -> None:
        await self._plain_verb("park", parameters)

    async def _clear(self, parameters: list[str]) -> None:
        await self._plain_verb("clear", parameters)

    async def _capture(self, parameters: list[str]) -> bytes:
        seconds = _number(parameters, 0)
        if not 0.0 < seconds <= CAPTURE_MOST_S:
            raise ScpiError(-222, f"{seconds:g} s, limits 0 to {CAPTURE_MOST_S:g} s")
        return _block(await self._stage.capture(*_FIELDS, seconds=seconds))


def _block(block: Block) -> bytes:
    """IEEE 488.2's definite-length block: doubles, least byte first, row by row."""
    data = np.concatenate([block[field] for field in _FIELDS], axis=1).astype("<f8").tobytes()
    length = str(len(data))
    return f"#{len(length)}{length}".encode("ascii") + data


def _forms() -> dict[str, str]:
    """What is understood, in capitals, each word in its long and its short form, by what it does."""
    found: dict[str, str] = {}
    for verb, header in HEADERS.items():
        form = header.form.split(" ")[0]
        forms = [""]
        for n, part in enumerate(form.replace("[", " ").replace("]", " ").split(" ")):
            optional = [] if n % 2 == 0 else forms
            forms = [*optional, *(begun + each for begun in forms for each in _word_forms(part))]
        for each in forms:
            found[each] = verb
    return found | {"MOVE:VEL?": "velocity", "MOVE:VELOCITY?": "velocity"}


def _word_forms(part: str) -> list[str]:
    words = [""]
    for n, word in enumerate(part.split(":")):
        colon = ":" if n else ""
        both = {word.upper(), "".join(c for c in word if not c.islower())}
        words = [begun + colon + each for begun in words for each in sorted(both)]
    return words


def _plain(head: str) -> str:
    return head.lstrip(":").upper()


def _axis(name: str) -> Axis:
    for axis in AXES:
        if name.lower() == axis:
            return axis
    raise ScpiError(-104, f"{name!r} is no axis: X, Y or Z")


def _named(values: dict[Axis, float]) -> dict[str, Any]:
    return {str(axis): value for axis, value in values.items()}


def _number(parameters: list[str], n: int) -> float:
    if len(parameters) <= n:
        raise ScpiError(-109)
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(parameters[n])):
            return value
    raise ScpiError(-104, f"{parameters[n]!r} is no number")


def _no_more_than(parameters: list[str], most: int) -> None:
    if len(parameters) > most:
        raise ScpiError(-108, ",".join(parameters[most:]))


def _axes_of(values: np.ndarray, parameters: list[str]) -> str:
    _no_more_than(parameters, 1)
    chosen = [AXES.index(_axis(parameters[0]))] if parameters else range(3)
    return ",".join(_text(float(values[n])) for n in chosen)


def _text(value: float) -> str:
    return f"{value:.9E}" if math.isfinite(value) else "9.91E+37"  # SCPI's not a number


def _said(error: StageError) -> ScpiError:
    words = str(error)
    if isinstance(error, RefusedError) and "limits" in words:
        return ScpiError(-222, words)
    if isinstance(error, RefusedError):
        return ScpiError(-221, words)
    return ScpiError(-240 if isinstance(error, AbortedError) else -200, words)
