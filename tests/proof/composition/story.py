"""A way through the composition as a person reads it, as lockstep's faults, and as a file that `explore.py` replays."""

import json

from configurations import DRIVE, LEVELS, NAMES, NODE_BEAT, OUR_BEAT, SENSE, SYNC, Configuration
from fates import Option, ViolationError
from frames import Relative
from world import Composition, World, choice_of, option_of

from pkxyz_ctrl.safety.modes import Event

_PARTS = {SENSE: "sense", DRIVE: "drive", SYNC: "sync", NODE_BEAT: "heartbeat", OUR_BEAT: "heartbeat"}
_KINDS = {"lose": "drop", "late": "delay", "repeat": "duplicate", "damage": "corrupt"}
FOLLOWED = 100  # steps
_LOCKSTEP_PERIOD_S = 200e-6


def tell(configuration: Configuration, way: list[Option]) -> str:
    """The story: what was asked, what went wrong, and what became of the combs. It is replayed to be told."""
    composition = Composition(configuration)
    world, lines, faults = World(composition), [], []
    violation, left, has_moved, follows = "", list(way), False, FOLLOWED
    while not violation and follows:
        choices = world.choices()
        if left and (len(choices) != 1 or (has_moved and world.is_landmark)):
            choice, has_moved = choice_of(composition, left.pop(0)), False
        elif len(choices) == 1:
            choice, has_moved = choices[0], True
            follows -= not left  # behind the last choice, what follows by itself
        else:
            break
        frame, option = world.frame(choice), option_of(composition, choice)
        was, combs, tick = world.mode, world.combs, max(world["ticks"] - 1, 0)
        is_at_work = world["ticks"] > 0
        try:
            world.take(choice)
        except ViolationError as found:
            violation = str(found)
        said = _said(option, frame)
        if world.mode != was:
            said.append(f"mode {was.name} -> {world.mode.name}")
        if world.combs != combs:
            said.append(f"combs {combs} -> {world.combs}")
        if said:
            lines.append(f"tick {tick:3}: " + "; ".join(said))
        if frame is not None and option[0] in _KINDS and is_at_work:
            faults.append(_fault(option[0], frame, tick))
    lines.append(f"VIOLATION: {violation}" if violation else f"ends in {world.mode.name}")
    return "\n".join([*lines, *faults])


def _said(option: Option, frame: Relative | None) -> list[str]:
    name = "" if frame is None else f"{NAMES[frame.can_id]} [{_held(frame)}]"
    match option[0]:
        case "tick":
            asked = [] if option[1] is Event.NONE else [f"asked: {option[1].name}"]
            asked += [f"the law wants {option[2]}"] if option[2] != LEVELS[0] else []
            asked += [f"the law wants outputs {option[4]:#04x}"] if option[4] else []
            return asked + (["a monitor trips"] if option[3] else [])
        case "late":
            return [f"{name} is held back"]
        case "release":
            return [f"{name} arrives only now"]
        case "repeat":
            return [f"{name} is kept, to come once more"]
        case "lose":
            return [f"{name} is lost"]
        case "damage":
            return [f"{name} is damaged, variant {option[1]}"]
        case "skip":
            return ["the controller misses this tick"]
        case "cut":
            return [f"from now on nothing gets through of: {option[1]}"]
        case "mend":
            return ["the cut is mended"]
    return []


def _held(frame: Relative) -> str:
    """What stands in it, a counter as the difference to its sender's."""
    payload = frame.payload
    return payload.hex(" ") if isinstance(payload, bytes) else ", ".join(map(str, payload))


def _fault(kind: str, frame: Relative, tick: int) -> str:
    """The same fault for ``pkxyz sil --fault``, in the same tick of a bus at 5 kHz, where lockstep has it."""
    part = _PARTS.get(frame.can_id)
    if part is None:
        return f"# lockstep has no fault of a single {NAMES[frame.can_id]}: replay the file"
    at_s = tick * _LOCKSTEP_PERIOD_S
    more = f",delay_us={_LOCKSTEP_PERIOD_S * 1e6:g}" if kind == "late" else ""
    return f"--fault bus.{part}:{_KINDS[kind]}@{at_s:.4f}+{_LOCKSTEP_PERIOD_S:.4f}{more}"


def as_text(configuration: Configuration, way: list[Option]) -> str:
    """A file for ``explore.py --replay``."""
    return json.dumps({"configuration": configuration.name, "way": way})


def from_text(text: str) -> tuple[str, list[Option]]:
    """The name of the configuration and the way."""
    data = json.loads(text)
    return data["configuration"], [_option(option) for option in data["way"]]


def _option(option: list[object]) -> Option:
    if option[0] == "tick":
        _, event, counts, trips, bits = option
        return "tick", Event(int(str(event))), tuple(counts), trips, bits  # type: ignore[arg-type]
    return tuple(option)
