"""The composition that is explored: shipped controller and shipped node, a wire that may do anything, any law, anybody.

Controller (driver, modes, monitors, cycle, gate) and amplifier node are the classes that run everywhere else; `sides`
asks each what it does. `Composition` holds what they answered, for the compiled part; `World` walks through it by hand.

What is small here and large elsewhere: the period is 20 ms, so that the shipped time-outs in ms are two or three
SYNCs; node and driver wait for some ticks only; the sense input gives up counting after 4 SYNCs (255), and the node's
errors last 30 ms (100). Each of these is compared with a count or an age and has no other effect, so a longer one
adds ticks in which the same things happen, and none else; that each order in which they can run out occurs is a
matter of the sizes in `CONFIGURATIONS`.

Where digital outputs or the signature are explored, the node's heartbeat goes along every other tick (every hundredth),
the signature is due every other SYNC (every 240th), and behind the voltages there is time for one frame of a byte more.
So ticks with and without a heartbeat, with and without a signature to be waited for, with and without room follow each
other in all orders; between two of a kind driver and node only count.
"""

from struct import Struct
from typing import Any, Final

import numpy as np
import product
import ticks
from any_law import LANDING_TICKS
from configurations import (
    CUTS,
    DRIVE,
    FROM_US,
    LATE_TICKS,
    PERIOD_US,
    POLL_US,
    REQUEST,
    SENSE,
    SETTLED,
    SIGNATURE,
    SIGNATURE_SYNCS,
    SYNC,
    TURNAROUND_US,
    Configuration,
)
from fates import Option, ViolationError, damaged
from frames import Relative, absolute, relative
from product import Rows
from sides import Answer, ControllerSide, Known, NodeSide
from states import Bases

from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.safety.modes import Event, Mode

_COUNTED: Final = {DRIVE: product.DRIVE_COUNTED, SYNC: product.SYNC_COUNTED, SENSE: product.SENSE_COUNTED}
_KINDS: Final = ("late", "repeat", "damage", "lose", "skip", "cut")
_NAMES: Final = (
    "deliver", "late", "repeat", "damage", "lose", "vanish", "go", "skip", "cut", "mend", "release", "tick",
)  # fmt: skip
_MUCH: Final = 1 << 16
_ANSWER: Final = Struct("<qihBBBB7H")  # of `product.ANSWER`
_NO_FRAMES: Final = (0,) * product.SENT_MOST
_ZERO: Final = Bases()


class Composition:
    """Both sides, and rows of what they did. ``rows`` changes its place when it grows: `resolve` says so."""

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        self.known = Known()
        self.controller, self.node = ControllerSide(configuration, self.known), NodeSide(configuration, self.known)
        self._on_wire: set[int] = set()  # frames that are sent, and not only made by damage
        self._labelled = {"frames": 0, "controllers": 0, "nodes": 0, "choices": 0}
        self.asked = 0
        self.rows = Rows(
            answers=_free_answers(_MUCH),
            controllers=np.zeros(_MUCH, product.CONTROLLER_LABEL), nodes=np.zeros(_MUCH, product.NODE_LABEL),
            frame_labels=np.zeros(_MUCH, product.FRAME_LABEL),
            choices=np.zeros((256, 1 + product.OPTIONS_MOST), np.int16), rules=self._rules(),
            missing=np.zeros(3, np.int64), asked=np.zeros((1 << 12, 3), np.int64), looks=np.zeros(2, np.int64),
        )  # fmt: skip
        self._place_of = direct(product.place_of, self.rows.answers, 0)
        self._note(self.controller.first)
        self._note(self.node.first)

    def _rules(self) -> np.ndarray[Any, Any]:
        c, rules = self.configuration, np.zeros(1, product.RULES)
        for kind in _KINDS:
            rules[kind] = kind in c.kinds
        rules["cut"] = sum(1 << place for place, cut in enumerate(CUTS) if cut in c.cuts)
        rules["unsigned_ticks"] = 2 * SIGNATURE_SYNCS + 3 + c.faults  # two are lost; it may ride a tick later
        rules["late_ticks"], rules["settled"] = LATE_TICKS, SETTLED
        rules["settle_ticks"], rules["agree_ticks"] = c.settle_ticks, c.agree_ticks
        rules["landing_ticks"] = LANDING_TICKS + 1 + c.faults  # a fault may be a tick that is missed
        rules["period_us"], rules["poll_us"], rules["turnaround_us"] = PERIOD_US, POLL_US, TURNAROUND_US
        rules["mode_landing"], rules["mode_enabled"] = Mode.LANDING, Mode.ENABLED
        return rules

    def first(self, world: np.ndarray[Any, Any]) -> None:
        """Make it what is there once both are switched on and the start-up has begun."""
        sent = self.controller.first.frames
        world[:] = np.zeros(1, product.WORLD)
        world["controller"], world["node"] = self.controller.first.to, self.node.first.to
        world["wire"][0, : len(sent)], world["on_wire"] = sent, len(sent)
        world["faults_left"] = self.configuration.faults

    def resolve(self) -> None:
        """Ask for what was missing."""
        side, state, asked = map(int, self.rows.missing)
        answer = (self.controller.answer, self.node.answer, self._shifted)[side](state, asked)
        self._make_room()
        self.asked += 1
        key = product.key_of(side, state, asked)
        at, frames = self._place_of(self.rows.answers, key), answer.frames
        _ANSWER.pack_into(
            self.rows.answers.data.cast("B"), at * _ANSWER.size, key, answer.to, answer.told,
            answer.drive, answer.sync, answer.sense, len(frames), *frames, *_NO_FRAMES[len(frames) :],
        )  # fmt: skip
        self._note(answer)

    def _shifted(self, number: int, further: int) -> Answer:
        """A frame, counted from where its sender is now."""
        frames = self.known.frames
        can_id, flags, payload = frames.things[number]
        if can_id == SYNC:
            shifted: tuple[Any, ...] = ((payload[0] - further) % 240,)
        else:
            a, b, c, counter, is_right = payload
            shifted = a, b, c, (counter - further) & 0xFF, is_right
        to = frames.number(Relative(can_id, flags, shifted))
        return Answer(to, 0, frames=(to,) if number in self._on_wire else ())

    def _note(self, answer: Answer) -> None:
        """Labels of what is new."""
        rows, known = self.rows, self.known
        frames = known.frames.things
        for number in answer.frames:
            if number not in self._on_wire:
                self._on_wire.add(number)
                made = [known.frames.number(relative(f, _ZERO)) for f in damaged(absolute(frames[number], _ZERO))]
                rows.frame_labels[number]["damages"] = len(made)
                rows.frame_labels[number]["damaged"][: len(made)] = made
        labels = self._labelled
        for number in range(labels["frames"], len(frames)):
            can_id, _, payload = frames[number]
            label = rows.frame_labels[number]
            label["from_us"], label["is_request"] = can_id in FROM_US, can_id == REQUEST
            label["is_signature"] = can_id == SIGNATURE and number in self._on_wire  # what the node says is right
            label["counted"] = _COUNTED.get(can_id, 0) if isinstance(payload, tuple) else 0
            label["cuts"] = sum(1 << 1 + cut for cut, ids in enumerate(CUTS.values()) if can_id in ids)
        for name, of_side, into in (
            ("controllers", self.controller.labels, rows.controllers),
            ("nodes", self.node.labels, rows.nodes),
        ):
            for number in range(labels[name], len(of_side)):
                into[number] = of_side[number]
            labels[name] = len(of_side)
        for number in range(labels["choices"], len(known.choices.things)):
            wishes = known.choices.things[number]
            rows.choices[number, 0], rows.choices[number, 1 : 1 + len(wishes)] = len(wishes), wishes
        labels["frames"], labels["choices"] = len(frames), len(known.choices.things)
        assert len(frames) < product.DIALOGUE

    def _make_room(self) -> None:
        """Half of the hash table stays free."""
        rows = self.rows
        if 2 * self.asked >= len(rows.answers):
            answers = _free_answers(2 * len(rows.answers))
            product.refill(answers, rows.answers)
            self.rows = rows = rows._replace(answers=answers)
        for name, side in (("controllers", self.controller), ("nodes", self.node)):
            held = getattr(rows, name)
            if side.kept.count >= len(held):
                self.rows = rows = rows._replace(**{name: np.concatenate((held, np.zeros_like(held)))})


def _free_answers(count: int) -> np.ndarray[Any, Any]:
    answers = np.zeros(count, product.ANSWER)
    answers["key"] = -1
    return answers


class World:
    """A walk through the composition, one choice after the other."""

    def __init__(self, composition: Composition) -> None:
        self.composition = composition
        self.state = np.zeros(1, product.WORLD)
        self.words = self.state.view(np.int64)
        self._may = np.zeros(product.OPTIONS_MOST, np.int32)
        composition.first(self.state)

    def choices(self) -> list[int]:
        """Everything that may happen now; the first is what happens when nothing goes wrong. None: it has ended."""
        return self._may[: ticks.options(self.state[0], self.composition.rows, self._may)].tolist()

    def take(self, choice: int) -> None:
        """Let one of `choices` happen. Raises `ViolationError`."""
        kept, looked = self.words.copy(), self.composition.rows.looks[1]
        while (told := ticks.take(self.state[0], self.composition.rows, choice)) == product.MISSING:
            self.words[:], self.composition.rows.looks[1] = kept, looked
            self.composition.resolve()
        if told == product.VIOLATED:
            raise ViolationError(violation_of(self.composition, self.state))

    def settle(self) -> None:
        """Go on until something has to be decided."""
        choices, has_moved = self.choices(), False
        while len(choices) == 1 and not (has_moved and self.is_landmark):
            self.take(choices[0])
            choices, has_moved = self.choices(), True

    @property
    def is_landmark(self) -> bool:
        return bool(ticks.is_landmark(self.state[0], self.composition.rows))

    def __getitem__(self, name: str) -> int:
        return int(self.state[name][0])

    @property
    def mode(self) -> Mode:
        return Mode(int(self.composition.rows.controllers["mode"][self["controller"]]))

    @property
    def driver(self) -> DriverState:
        return DriverState(int(self.composition.rows.controllers["driver"][self["controller"]]))

    @property
    def combs(self) -> Counts:
        counts: Counts = self.composition.known.counts.things[self.composition.rows.nodes["counts"][self["node"]]]
        return counts

    def frame(self, choice: int) -> Relative | None:
        """Which one a choice is about."""
        frames, kind = self.composition.known.frames.things, choice >> 8
        if kind == product.RELEASE:
            found: Relative = frames[self.state["held"][0, choice & 0xFF]]
            return found
        return frames[self.state["wire"][0, 0]] if self["on_wire"] else None


def option_of(composition: Composition, choice: int) -> Option:
    """A choice in words that last."""
    kind, which = _NAMES[choice >> 8], choice & 0xFF
    match kind:
        case "tick":
            return kind, *composition.known.wishes.things[which]
        case "cut":
            return kind, tuple(CUTS)[which]
        case "damage" | "release":
            return kind, which
    return (kind,)


def choice_of(composition: Composition, option: Option) -> int:
    """The other way round."""
    kind, which = _NAMES.index(option[0]) << 8, 0
    if option[0] == "tick":
        which = composition.known.wishes.number((Event(option[1]), tuple(option[2]), option[3], option[4]))
    elif option[0] == "cut":
        which = tuple(CUTS).index(option[1])
    elif len(option) > 1:
        which = option[1]
    return kind | which


def violation_of(composition: Composition, state: np.ndarray[Any, Any]) -> str:
    """What must not be, and is."""
    number, world, known = int(state["violation"][0]), state[0], composition.known
    combs = known.counts.things[composition.rows.nodes["counts"][world["node"]]]
    match number:
        case product.STARTED_WITH_VOLTAGE:
            return "a start-up that failed leaves a voltage"
        case product.CLOSED_TOO_SOON:
            return f"the loop is closed after {world['quiet']} quiet ticks, {SETTLED} are asked for"
        case product.LANDING_FOR_EVER:
            return f"the stage has been led down for {world['landing']} ticks"
        case product.TOO_LATE_AT_0_V:
            return f"{world['since_decision']} ticks after the decision the combs hold {combs}"
        case product.APART_TOO_LONG:
            believed = known.counts.things[world["believed"]]
            return f"for {world['apart']} ticks the gate takes combs at {combs} to be at {believed}"
        case product.TOO_LATE_LOW:
            bits = composition.rows.nodes[world["node"]]["bits"]
            return f"{world['high']} ticks after the decision the digital outputs are still {bits:#04x}"
        case product.UNSIGNED_TOO_LONG:
            return f"the loop has been closed for {world['unsigned']} ticks without a signature"
        case product.NO_ROOM:
            return "more frames are on their way than there is room for"
    text: str = known.violations.things[number]
    return text
