"""What clients set of a stage: told to the loop, and kept once the loop has taken it."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from hil.operate.commands import FINAL, State, Verb
from hil.operate.sample_axes import SampleAxes, Turn
from hil.server.link import Answer, Link
from hil.server.messages import AskedWrongError, number
from hil.server.paths import Planner
from hil.server.stored_settings import MoveLimits, SettingsStore, SettleWindow, StageSettings
from pkxyz_ctrl.config.files import parse

ASKED: Final = frozenset({"sample", "tilt_plane", "limits", "settle", "name_position", "forget_position", "restore"})
"""What is asked for here."""
_WHO_MOST = 60


class Setting:
    """Of one stage. ``changed`` is called after each change."""

    def __init__(self, link: Link, planner: Planner, store: SettingsStore, changed: Callable[[], object]) -> None:
        self._link, self._planner, self._store, self._changed = link, planner, store, changed
        self._own: set[int] = set()  # commands of which nobody has to hear by themselves
        self._waiting: dict[int, tuple[str, str, str, StageSettings]] = {}  # by command: verb, who, what, then

    def told(self) -> dict[str, Any]:
        """What is set, and the history, as plain data."""
        return self._store.told()

    def position(self, name: Any) -> tuple[float, float, float]:
        """One that has a name, m, of the sample. Raises ``AskedWrongError``."""
        positions = self._store.now.positions
        if name not in positions:
            raise AskedWrongError(f"no position is called {name!r}; there are: {', '.join(positions) or 'none'}")
        return positions[name]

    def joined(self) -> None:
        """There is a loop, which may be a new one, or the server is: it is told what is set."""
        self._describe()
        if self._store.changes:
            self._tell_loop(self._store.now)
        else:
            newest = self._link.newest()
            if newest is not None:
                self._planner.turn = Turn(newest["session"]["matrix"])

    def ask(self, what: str, message: dict[str, Any]) -> tuple[int | None, str]:
        """Begin a change; returns the id of the command that it takes, or None where it is done, and words. Raises
        ``AskedWrongError``, ``ConfigError``, ``BusyError``.
        """
        who, now = str(message.get("who", "somebody"))[:_WHO_MOST], self._store.now
        if what in ("name_position", "forget_position"):
            words, wanted = self._positions(what, message)
            self._keep(who, words, wanted)
            return None, words
        if what == "restore":
            wanted = self._store.back_to(str(message.get("digest", "")))
            words = f"back to {wanted.digest}"
        elif what == "limits":
            changed = {name: number(message, name, None) for name in MoveLimits.model_fields if name in message}
            limits = parse(now.limits.model_dump() | changed, MoveLimits, what)
            wanted, words = now.model_copy(update={"limits": limits}), "limits of moves"
        elif what == "settle":
            changed = {name: number(message, name, None) for name in SettleWindow.model_fields if name in message}
            wanted = now.model_copy(update={"settle": parse(now.settle.model_dump() | changed, SettleWindow, what)})
            words = "settle window"
        else:
            wanted, words = now.model_copy(update={"sample": self._sample(what, message)}), "axes of the sample"
            self._require_rest()
        last = self._tell_loop(wanted)
        self._waiting[last] = (what, who, words, wanted)
        return last, words

    def heard(self, answer: Answer) -> tuple[str, str] | None:
        """What became of a command: by which verb it was asked for, and words. None for what is nobody's business."""
        waiting = self._waiting.get(answer.id)
        is_own = answer.id in self._own
        if answer.state in FINAL:
            self._own.discard(answer.id)
        if waiting is None:
            return None if is_own else (answer.verb, answer.words)
        if answer.state in FINAL:
            del self._waiting[answer.id]
        verb, who, words, wanted = waiting
        if answer.state is not State.DONE:
            return verb, answer.words
        self._keep(who, words, wanted)
        return verb, f"{words}: settings {wanted.digest}"

    def _keep(self, who: str, what: str, settings: StageSettings) -> None:
        self._store.set(who, what, settings)
        self._describe()
        self._changed()

    def _describe(self) -> None:
        now = self._store.now
        self._planner.turn = Turn(now.sample.matrix())
        if self._store.changes:
            self._link.description |= {
                "limits": list(now.limits.model_dump().values()), "window_m": now.settle.window_m,
                "dwell_s": now.settle.dwell_s,
            }  # fmt: skip

    def _tell_loop(self, settings: StageSettings) -> int:
        """All of it, the sample's axes last; returns the id of that command."""
        link = self._link
        limits, settle, last = (link.next_id() for _ in range(3))
        self._own |= {limits, settle, last}
        link.command(Verb.LIMITS, limits, **settings.limits.model_dump())
        link.command(Verb.SETTLE, settle, **settings.settle.model_dump())
        link.command(Verb.SAMPLE, last, matrix=settings.sample.matrix())
        return last

    def _sample(self, what: str, message: dict[str, Any]) -> SampleAxes:
        now = self._store.now.sample
        if what == "sample":
            changed = {name: message[name] for name in SampleAxes.model_fields if name in message}
            return parse(now.model_dump() | changed, SampleAxes, "sample")
        try:
            points = np.array(message.get("points_m"), np.float64)
        except (ValueError, TypeError):
            points = np.zeros(0)
        if points.shape != (3, 3):
            raise AskedWrongError("a plane goes through three points: points_m of 3 times x, y, z in m")
        return now.through(self._planner.turn.to_stage(points))

    def _require_rest(self) -> None:
        newest = self._link.newest()
        if newest is not None and newest["session"]["running_id"]:
            raise AskedWrongError("the axes of the sample are changed while nothing runs: wait, or abort first")

    def _positions(self, what: str, message: dict[str, Any]) -> tuple[str, StageSettings]:
        now, name = self._store.now, message.get("name")
        positions = dict(now.positions)
        if what == "forget_position":
            self.position(name)
            positions.pop(str(name))
            return f"{name} is forgotten", now.model_copy(update={"positions": positions})
        newest = self._link.newest()
        if newest is None:
            raise AskedWrongError("the loop is not there yet")
        here = self._planner.turn.to_sample(newest["session"]["target_m"])
        place = [number(message, f"{axis}_m", float(here[n])) for n, axis in enumerate("xyz")]
        positions[str(name)] = (place[0], place[1], place[2])
        wanted = parse(now.model_dump() | {"positions": positions}, StageSettings, "position")
        where = ", ".join(f"{round(v * 1e6, 4) + 0.0:g}" for v in place)
        return f"{name} is ({where}) um", wanted
