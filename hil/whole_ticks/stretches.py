"""Stretches of whole ticks: when there may be one, and what it is handed and leaves behind."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.bus.clock import Lockstep
from hil.bus.endpoint import Endpoint
from hil.bus.frame_log import FrameLog
from hil.bus.frame_time import to_end_ns
from hil.bus.wire import Wire
from hil.bus.wire_rules import clear
from hil.faults.channels import DICE
from hil.faults.frame_rules import RULE
from hil.faults.injection import Injection
from hil.faults.plant import channels_of
from hil.faults.wire import SENDERS
from hil.node.alarm import Alarm
from hil.node.amplifier import AmplifierNode
from hil.node.rules import OPERATIONAL
from hil.plant.on_bus import PlantOnBus
from hil.whole_ticks.happenings import BENCH, INBOX, NEVER_US
from hil.whole_ticks.node_at_work import NodeAtWork
from hil.whole_ticks.ticks import whole_ticks
from pkxyz_ctrl.can.driver import bytes_of, word_of
from pkxyz_ctrl.can.frame import UNUSUAL, Frame
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.loop.row import ROW

Records = NDArray[np.void]

_LOG_BYTES: Final = 1 << 20
_ROOM_TICKS: Final = 1
_WATCHED_MOST: Final = 4096  # ticks of a stretch whose combs are watched


class Stretches:
    """Runs as many ticks as there are that can be played in one go; then everything stands as if each of their events
    had happened by itself. Where somebody else than ``known`` is on the wire there are none.
    """

    def __init__(
        self, clock: Lockstep, wire: Wire, endpoint: Endpoint, node: AmplifierNode, plant: PlantOnBus,
        controller: Controller, log: FrameLog | None, known: tuple[Endpoint, ...], injection: Injection | None,
    ) -> None:  # fmt: skip
        self._clock, self._wire, self._endpoint, self._log = clock, wire, endpoint, log
        self._plant, self._controller = plant, controller
        self._known = known
        self._senders = [next(e for e in known if e.name == name) for name in SENDERS]
        self._node, self._alarms = NodeAtWork(node), node.work_alarms
        self._faults = None if injection is None else injection.wire_faults
        self._bench = bench = np.zeros(1, BENCH)
        medium = bench["wire"][0]
        medium["nominal_bitrate"] = wire.nominal_bitrate
        medium["data_bitrate"] = wire.data_bitrate or wire.nominal_bitrate
        medium["to_end_ns"] = to_end_ns(wire.nominal_bitrate)
        clear(medium)
        can = controller.can
        bench["period_us"], bench["compute_us"] = controller.period_us, can.compute_us
        bench["answer_us"], bench["heartbeat_us"] = can.sense_deadline_us, can.heartbeat_deadline_us
        bench["is_logged"] = log is not None
        channel = np.frombuffer((log.channel if log is not None else "").encode("ascii"), np.uint8)
        self._text = np.zeros(_LOG_BYTES, np.uint8)
        self.watched_v = np.zeros((_WATCHED_MOST, 3))
        """(n, 3): voltages at the combs behind each tick of the last stretch, where they are watched"""
        state, (channels, dice) = plant.plant.state, channels_of(plant)
        rules, rolled = np.zeros(0, RULE), np.zeros(1, DICE)
        if self._faults is not None:
            rules, rolled = self._faults.rules, self._faults.dice
        changed = controller.exchange, self._node.memory, state, plant.record, bench, channels, dice, rolled
        live = tuple(part.view(np.int64) for part in changed)
        kept = tuple(part.copy() for part in live)
        self._before = (
            (controller.record, controller.exchange), (self._node.record, self._node.memory),
            (plant.plant.params, state, plant.record, channels, dice), (rules, rolled, channel, self._text), bench,
        )  # fmt: skip
        self._behind = self.watched_v, live, kept
        room = np.zeros(_ROOM_TICKS, ROW)
        self._run = direct(whole_ticks, *self._before, standing_still(), room, *self._behind)

    def keep(self, *, begun_anew: bool, watched: bool) -> None:
        """Whether somebody acts on ticks that end in ENABLED, and whether the combs are watched."""
        self._bench["is_begun_anew"], self._bench["is_watched"] = begun_anew, watched

    def may_begin(self, t_us: int, injection: Injection | None) -> bool:
        """Whether the tick that begins at ``t_us`` might be whole. What is due until then happens."""
        clock, wire, plant, bench = self._clock, self._wire, self._plant, self._bench
        clock.wait_until(t_us)
        if clock.now_us != t_us or wire.endpoints != self._known or plant.origin_us is None:
            return False
        faults = self._faults
        if not wire.is_calm(None if faults is None else faults.judge):
            return False
        due_us = [clock.first_us(self._is_foreign), plant.quiet_until_us]
        if injection is not None:
            due_us.append(injection.quiet_until_us(t_us))
            bench["late_us"] = injection.late_us(t_us)
        horizon_us = min(NEVER_US if at_us is None else at_us for at_us in due_us)
        bench["horizon_us"] = horizon_us
        return t_us + self._controller.period_us < horizon_us

    def run(self, reference: Records, rows: Records, t_us: int) -> int:
        """Up to ``len(rows)`` ticks from ``t_us`` on, now; returns how many were whole. ``may_begin`` has said yes."""
        bench, medium, plant, wire = self._bench[0], self._bench["wire"][0], self._plant, self._wire
        if bench["is_watched"]:
            rows = rows[:_WATCHED_MOST]
        waiting = self._endpoint.receive_all()
        state = OPERATIONAL if self._node.take() else self._node.take_at_rest()
        if len(rows) == 0 or state is None or not self._take_inbox(waiting):
            self._endpoint.put_back(waiting)
            return 0
        bench["node_state"], bench["is_disturbed"], bench["commanded"] = (
            state,
            plant.is_disturbed,
            self._node.node.outputs,
        )
        bench["t_us"], bench["plant_us"], bench["origin_us"] = t_us, plant.plant_us, plant.origin_us
        bench["logged"] = bench["frames"] = 0
        bench["was_sampled"] = plant.was_sampled
        bench["rules"] = 0 if self._faults is None else self._faults.count
        medium["free_ns"], medium["busy_ns"], medium["frames"] = wire.carried
        medium["transmit_errors"] = [e.transmit_errors for e in self._senders]
        medium["receive_errors"] = [e.receive_errors for e in self._senders]
        done = int(self._run(*self._before, reference, rows, *self._behind))
        if done == 0:
            self._endpoint.put_back(waiting)
            return 0
        wire.carried = int(medium["free_ns"][0]), int(medium["busy_ns"][0]), int(medium["frames"][0])
        for sender, sent, received in zip(
            self._senders, medium["transmit_errors"][0].tolist(), medium["receive_errors"][0].tolist(), strict=True
        ):
            sender.transmit_errors, sender.receive_errors = sent, received
        if state == OPERATIONAL:
            self._node.put()
        else:
            self._node.put_at_rest()
        plant.take_over(int(bench["plant_us"]), self._node.node.outputs)
        end_us = int(bench["t_us"])
        left = bench["inbox"][: bench["received"]]
        self._endpoint.put_back([(_frame_of(frame), end_us) for frame in left])
        if self._log is not None:
            self._log.write_lines(self._text[: bench["logged"]].tobytes(), int(bench["frames"]))
        self._clock.leap(end_us)
        return done

    def _take_inbox(self, waiting: list[tuple[Frame, int]]) -> bool:
        if len(waiting) > INBOX or any(len(f.data) > 8 or f.flags & UNUSUAL for f, _ in waiting):
            return False
        self._bench["received"] = len(waiting)
        for place, ((can_id, data, flags), _) in zip(self._bench["inbox"][0], waiting, strict=False):
            place["word"], place["can_id"], place["length"], place["flags"] = word_of(data), can_id, len(data), flags
        return True

    def _is_foreign(self, event: Callable[[], object]) -> bool:
        """Whether an event is another one than an alarm of the node's which the compiled part looks after."""
        owner = getattr(event, "__self__", None)
        return not isinstance(owner, Alarm) or (owner.due_us is not None and owner not in self._alarms)


def _frame_of(frame: np.void) -> Frame:
    return Frame._make((int(frame["can_id"]), bytes_of(int(frame["word"]), int(frame["length"])), int(frame["flags"])))
