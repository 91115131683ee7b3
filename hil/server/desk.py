"""The desk at which clients stand: who holds control, what each may ask, and what each is told.

It knows messages and no sockets: a client is whatever takes texts and bytes.
"""

import contextlib
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np

from hil.operate.commands import FINAL, State, Verb
from hil.server.client import Client, Moment
from hil.server.designing import Choice, offer_of
from hil.server.link import Answer, BusyError, Link
from hil.server.messages import FIELDS, AskedWrongError, number, of_sample, pixels_of, shown, tag_of, trigger_of
from hil.server.messages import answer as answer_of
from hil.server.opening import listed, opened, values_of
from hil.server.paths import Feeding, Planner, StagePath
from hil.server.saving import AFTER_S, BEFORE_S, NotSavedError, save
from hil.server.setting import ASKED, Setting
from hil.server.status import BusLoad, Due, status_of
from hil.server.stopping import Stopping
from hil.server.stored_settings import SettingsStore
from pkxyz_ctrl.config.files import ConfigError

_AXES = ("x", "y", "z")
_LIMITS = ("velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3")
_LOOKS = frozenset({"settings", "values", "parameters", "recordings", "open_recording", "laws"})
_FREE = _LOOKS | {"stop", "release", "subscribe", "take_control", "give_control", "preview", "body", "save"}
"""What needs no control: nothing of it moves anything, or it stops what moves."""
_STOPPED = "the stage was stopped after this was asked, and before it began: ask again"


class Desk:
    """``plan`` runs a function where it doesn't hold up the others."""

    def __init__(
        self,
        link: Link,
        planner: Planner,
        plan: Callable[..., Awaitable[Any]],
        saves: Path = Path("runs"),
        store: SettingsStore | None = None,
    ) -> None:
        """``saves``: where faults are kept; ``store``: where settings are."""
        self.link = link
        self.saved = ""
        """where the last fault is kept, or why it isn't"""
        self._saves, self._fault_us = saves, -1
        self.clients: list[Client] = []
        self.stops = 0
        """how often somebody has stopped the stage"""
        self.holder: Client | None = None
        self.last_fault = ""
        self._planner, self._plan = planner, plan
        self._choice = Choice(planner.files["stage"], planner.files["bus"], plan)
        self._feeding: Feeding | None = None
        self._asked_for: Feeding | None = None  # fed once the loop has begun it; another may be running
        self._stopping = Stopping(link, self._tell)
        self._jog_id = 0
        self._jog_direction = [0.0, 0.0, 0.0]
        self._numbers = 0
        self._bus_load, self._due = BusLoad(), Due()
        self._heeds_silence = False
        self._setting = Setting(link, planner, store or SettingsStore(), self._settings_changed)

    # -- clients -------------------------------------------------------------------------------------------------------

    def enter(self) -> Client:
        """Somebody is connected."""
        self._numbers += 1
        client = Client(self._numbers)
        self.clients.append(client)
        client.tell(self._hello(client))
        self._tell_control(client)
        client.tell({"settings": self._setting.told()})
        if self.last_fault:
            client.tell({"event": {"kind": "fault", "words": self.last_fault, "old": True}})
        return client

    def _hello(self, client: Client) -> dict[str, Any]:
        return {"hello": self.link.description | {"fields": sorted(FIELDS), "client": client.number}}

    def leave(self, client: Client) -> None:
        """Somebody is gone; what was moved by hand ends."""
        if client in self.clients:
            self.clients.remove(client)
        if self.holder is client:
            self._end_control()

    async def ask(self, client: Client, text: str, stops: int | None = None) -> None:
        """A message from a client, that came when ``stops`` was so. What is wrong with it, it is told."""
        stops = self.stops if stops is None else stops
        tag = None
        try:
            message = json.loads(text)
            if not isinstance(message, dict) or not isinstance(message.get("do"), str):
                raise AskedWrongError('a message is {"do": what, ...}')
            tag = tag_of(message.get("tag"))
            await self._do(client, message["do"], message, tag, stops)
        except (AskedWrongError, BusyError, ConfigError, RecursionError, ValueError, TypeError) as error:
            ours = isinstance(error, AskedWrongError | BusyError | ConfigError)
            words = str(error) if ours else f"not understood: {error}"
            client.tell({"answer": {"tag": tag, "id": None, "verb": "", "state": "refused", "words": words}})

    async def _do(self, client: Client, what: str, message: dict[str, Any], tag: Any, stops: int) -> None:
        if what not in _FREE and self.holder is not client:
            raise AskedWrongError(
                "take control first: " + ("nobody has it" if self.holder is None else "another client has it")
            )
        if what not in _FREE and stops != self.stops:
            raise AskedWrongError(_STOPPED)
        if what == "release":
            self.stops += 1
            self._command(client, what, message, tag)
        elif what == "stop":
            self.stops += 1
            self._feeding = self._asked_for = None
            stop_id = self.link.next_id()
            client.tags[stop_id] = tag
            self._stopping.ask(stop_id)
        elif what == "subscribe":
            client.subscribe(message)
        elif what == "take_control":
            self._take_control(client, tag)
        elif what == "give_control":
            if self.holder is client:
                self._end_control()
            client.tell(answer_of(tag, "give_control", "done", ""))
        elif what == "preview":
            path = await self._planned(message)
            client.tell({"preview": {"tag": tag, **await self._plan(shown, path)}})
        elif what == "body":
            client.tell({"body": await self._plan(self._planner.body, self.link.stands_m)})
        elif what == "save":
            seconds = number(message, "seconds", 60.0)
            client.tell(answer_of(tag, "save", "done", await self._kept(min(max(seconds, 0.1), 60.0), "")))
        elif what in _LOOKS:
            await self._look_at(client, what, message)
            client.tell(answer_of(tag, what, "done", ""))
        elif what == "path":
            await self._send_path(client, message, tag, stops)
        elif what == "law":
            await self._change_law(client, message, tag, stops)
        elif what in ASKED:
            command_id, words = self._setting.ask(what, message)
            if command_id is None:
                client.tell(answer_of(tag, what, "done", words))
            else:
                client.tags[command_id] = tag
                self._tell(what, command_id, State.ACCEPTED, words)
        else:
            self._command(client, what, message, tag)

    async def _look_at(self, client: Client, what: str, message: dict[str, Any]) -> None:
        if what == "settings":
            client.tell({"settings": self._setting.told()})
        elif what == "parameters":
            client.tell({"parameters": self._planner.parameters})
        elif what == "laws":
            self._choice.tell(client.tell)
        elif what == "recordings":
            names = await self._plan(listed, self._saves)
            client.tell({"recordings": {"folder": str(self._saves), "names": names}})
        elif what == "open_recording":
            about, block = await self._plan(opened, self._saves, message.get("name"), client.fields)
            if not client.has_room:
                raise AskedWrongError("blocks that were asked for before still wait: take them, and open it again")
            client.show_opened(about, block)
        elif (newest := self.link.newest()) is not None:
            client.tell({"values": values_of(of_sample(np.array([newest])))})

    # -- control -------------------------------------------------------------------------------------------------------

    def _take_control(self, client: Client, tag: Any) -> None:
        if self.holder not in (None, client):
            raise AskedWrongError("another client has control; it has to give it back, or to leave")
        self.holder = client
        client.tell(answer_of(tag, "take_control", "done", "you have control"))
        self._tell_all_control()

    def _end_control(self) -> None:
        self.holder = None
        if self._jog_id:
            self._end_jog()
        self._tell_all_control()

    def _end_jog(self) -> None:
        with contextlib.suppress(BusyError):  # its lease ends by itself
            self.link.command(Verb.JOG, self.link.next_id(), target_m=(0.0, 0.0, 0.0))
        self._jog_id = 0

    def _tell_all_control(self) -> None:
        for client in self.clients:
            self._tell_control(client)

    def _tell_control(self, client: Client) -> None:
        client.tell({"control": {"held": self.holder is not None, "yours": self.holder is client}})

    # -- commands ------------------------------------------------------------------------------------------------------

    def _command(self, client: Client, what: str, message: dict[str, Any], tag: Any) -> None:
        fields: dict[str, Any] = {}
        if what == "jog_again":
            if self._jog_id:
                self.link.command(Verb.JOG, self._jog_id, target_m=self._jog_direction)
            return
        if what == "jog_end":
            self._end_jog()
            return
        try:
            verb = Verb[what.upper()]
        except KeyError:
            raise AskedWrongError(f"there is nothing called {what!r} to do") from None
        if verb in (Verb.SAMPLE, Verb.LAW):
            raise AskedWrongError(f"{what} is asked otherwise")
        if verb in (Verb.TRIGGER, Verb.QUIET):
            fields = trigger_of(message) if verb is Verb.TRIGGER else {"on": int(bool(message.get("on", True)))}
        if verb is Verb.MOVE and "to" in message:
            fields["target_m"] = self._setting.position(message["to"])
        elif verb is Verb.MOVE:
            fields["target_m"] = [number(message, f"{axis}_m", np.nan) for axis in _AXES]
            fields["relative"] = int(bool(message.get("relative", False)))
        if verb is Verb.JOG:
            axis, sign = message.get("axis"), number(message, "direction", 1.0)
            if axis not in _AXES or sign == 0:
                raise AskedWrongError("jog needs axis x, y or z, and a direction of 1 or -1")
            self._jog_direction = [float(np.sign(sign)) * (a == axis) for a in _AXES]
            fields["target_m"] = self._jog_direction
        if verb in (Verb.MOVE, Verb.JOG):
            fields |= {name: number(message, name, 0.0) for name in _LIMITS}
        command_id = self.link.next_id()
        self.link.command(verb, command_id, **fields)
        client.tags[command_id] = tag
        if verb is Verb.JOG:
            self._jog_id = command_id
        self._tell(Verb(verb).name.lower(), command_id, State.ACCEPTED, "")

    async def _planned(self, message: dict[str, Any]) -> StagePath:
        pixels, stands_m = pixels_of(message), self.link.stands_m
        if "scenario" in message:
            return await self._plan(self._planner.of_scenario, str(message["scenario"]), pixels)
        if "table" in message:
            limits = {name.replace("_m_per_s", "_max_m_per_s"): message.get(name) for name in _LIMITS}
            return await self._plan(self._planner.of_table, str(message["table"]), limits, stands_m)
        return await self._plan(self._planner.of_segments, message.get("segments"), pixels, stands_m)

    async def _send_path(self, client: Client, message: dict[str, Any], tag: Any, stops: int) -> None:
        path = await self._planned(message)
        self._require_still_wanted(client, stops)
        command_id = self.link.next_id()
        ends = {"start_m": path.start_m, "target_m": path.end_m}
        self.link.command(Verb.PATH, command_id, path=command_id, rows=path.rows, **ends)
        client.tags[command_id] = tag
        self._asked_for = Feeding(self.link, command_id, path)
        self._tell("path", command_id, State.ACCEPTED, f"{path.name}: {path.duration_s:.3g} s")

    async def _change_law(self, client: Client, message: dict[str, Any], tag: Any, stops: int) -> None:
        name, text = str(message.get("controller", "")), message.get("toml")
        command_id = self.link.next_id()
        files = self._planner.files
        text = None if text is None else str(text)
        offered = await self._plan(offer_of, files["stage"], files["bus"], name, text, command_id)
        self._require_still_wanted(client, stops)
        self.link.offer(offered)
        self.link.command(Verb.LAW, command_id, law=command_id)
        client.tags[command_id] = tag
        self._tell("law", command_id, State.ACCEPTED, "")

    def _require_still_wanted(self, client: Client, stops: int) -> None:
        """Of what took its time: nobody has stopped the stage meanwhile, and the client still has control."""
        if stops != self.stops:
            raise AskedWrongError(_STOPPED)
        if self.holder is not client:
            raise AskedWrongError("control was given away while it was prepared")

    def _settings_changed(self) -> None:
        for client in self.clients:
            client.tell(self._hello(client))
            client.tell({"settings": self._setting.told()})

    # -- what the loop says --------------------------------------------------------------------------------------------

    @property
    def is_waited_for(self) -> bool:
        """Whether the loop has something to answer or to be fed with, or would do something if it heard nothing."""
        return self._heeds_silence or self._feeding is not None or any(client.tags for client in self.clients)

    def look(self) -> None:
        """Hand on what has come from the loop, and feed it."""
        if not self.link.is_joined:
            if not self.link.join():
                return
            self._setting.joined()
            for client in self.clients:
                client.tell(self._hello(client))
        self.link.sign_of_life()
        self.link.answers(self._heard)
        if self._feeding is not None and not self._feeding.go_on():
            self._feeding = None

    def _heard(self, answer: Answer) -> None:
        if answer.is_fault:
            self.last_fault, self._fault_us = answer.words, answer.t_us
            for client in self.clients:
                client.tell({"event": {"kind": "fault", "words": answer.words, "t_us": answer.t_us}})
            return
        if answer.verb == "clear" and answer.state is State.DONE:
            self.last_fault = self.saved = ""
        if self._asked_for is not None and self._asked_for.number == answer.id:
            if answer.state not in FINAL:
                self._feeding = self._asked_for
            self._asked_for = None
        if answer.verb == "stop":
            self._stopping.heard(answer)
            return
        told = self._setting.heard(answer)
        if answer.state in FINAL:
            if self._feeding is not None and self._feeding.number == answer.id:
                self._feeding = None
            if answer.id == self._jog_id:
                self._jog_id = 0
        if told is not None:
            self._tell(told[0], answer.id, answer.state, told[1])

    async def keep_fault(self) -> None:
        """Save what was around a fault, once that is over."""
        if self._fault_us < 0 or (newest := self.link.newest()) is None:
            return
        since_s = (int(newest["row"]["t_us"]) - self._fault_us) * 1e-6
        if since_s < AFTER_S and self.link.is_alive:
            return
        self._fault_us = -1
        self.saved = await self._kept(BEFORE_S + since_s, self.last_fault)
        for client in self.clients:
            client.tell({"event": {"kind": "saved", "words": self.saved}})

    async def _kept(self, seconds: float, why: str) -> str:
        try:
            return str(await self._plan(save, self.link.memory, self.link.description, seconds, why, self._saves))
        except NotSavedError as error:
            return str(error)

    def _tell(self, verb: str, command_id: int, state: State, words: str) -> None:
        if state in FINAL:
            self.tell_status()  # whoever waited for the end looks where the stage is now
        for client in self.clients:
            tag = client.tags.get(command_id)
            if state in FINAL:
                client.tags.pop(command_id, None)
            client.tell(answer_of(tag, verb, state.name.lower(), words, command_id))

    def tell_status(self, *, is_in_turn: bool = False) -> None:
        """Where the stage is, to everybody; ``is_in_turn``: more seldom while nothing happens."""
        newest = self.link.newest()
        if newest is None:
            status: dict[str, Any] = {"activity": "starting", "words": "the loop is starting", "alive": False}
        else:
            load = self._bus_load.at(newest)
            status = status_of(newest, self.link.description, load) | {"alive": self.link.is_alive}
            status["range_m"] = self._planner.ranges(newest["session"]["target_m"])
            parks = status["driven"] and self.link.description.get("on_silence") == "park"
            self._heeds_silence = parks or status["running_id"] != 0
        status |= {
            "last_fault": self.last_fault,
            "saved": self.saved,
            "held": self.holder is not None,
            "clients": len(self.clients),
        }
        if not self._due.is_due(status) and is_in_turn:
            return
        text = json.dumps({"status": status}, allow_nan=False)
        for client in self.clients:
            client.tell_status(text)

    # -- telemetry -----------------------------------------------------------------------------------------------------

    def show_telemetry(self, most: int) -> None:
        """New rows to whoever asked for them."""
        if not self.link.is_joined:
            return
        ticks, before = self.link.ticks, self.link.ticks.lost
        looking = [client for client in self.clients if client.fields]
        if not looking:
            ticks.skip()
        elif len(rows := ticks.read_block(most)):
            moment = Moment(int(rows["row"]["tick"][0]), of_sample(rows))
            for client in looking:
                client.lost += ticks.lost - before
                client.show(moment)
