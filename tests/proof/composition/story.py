"""A way through the composition as a person reads it, as lockstep's faults, and as a file that `explore.py` replays."""

import json

from configurations import DRIVE, LEVELS, NAMES, NODE_BEAT, OUR_BEAT, PERIOD_US, SENSE, SYNC, Configuration
from fates import Option, ViolationError
from world import World, learnt

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety.modes import Event, Mode

_PARTS = {SENSE: "sense", DRIVE: "drive", SYNC: "sync", NODE_BEAT: "heartbeat", OUR_BEAT: "heartbeat"}
_KINDS = {"lose": "drop", "late": "delay", "repeat": "duplicate", "damage": "corrupt"}
FOLLOWED = 100  # steps
_LOCKSTEP_PERIOD_S = 200e-6


def tell(configuration: Configuration, way: list[Option]) -> str:
    """The story: what was asked, what went wrong, and what became of the combs. It is replayed to be told."""
    world, lines, faults = World(configuration, learnt(configuration)), [], []
    first_us: int | None = None
    violation = ""
    for option in [*way, *[()] * FOLLOWED]:
        if not option:  # behind the last choice, what follows by itself
            options = world.options()
            if len(options) != 1 or violation:
                break
            option = options[0]
        if world.phase == "before" and first_us is None:
            first_us = world.tick_us
        frame = world.wire[0] if world.wire else world.held[option[1]].frame if option[0] == "release" else None
        was, combs = world.controller.mode, world.plant.counts
        tick = 0 if first_us is None else (world.clock.now_us - first_us) // PERIOD_US
        try:
            world.take(option)
        except ViolationError as found:
            violation = str(found)
        said = _said(option, frame)
        if world.controller.mode != was:
            said.append(f"mode {Mode(was).name} -> {Mode(world.controller.mode).name}")
        if world.plant.counts != combs:
            said.append(f"combs {combs} -> {world.plant.counts}")
        if said:
            lines.append(f"tick {tick:3}: " + "; ".join(said))
        if frame is not None and option[0] in _KINDS and first_us is not None:
            faults.append(_fault(option[0], frame, tick))
    lines.append(f"VIOLATION: {violation}" if violation else f"ends in {Mode(world.controller.mode).name}")
    return "\n".join([*lines, *faults])


def _said(option: Option, frame: Frame | None) -> list[str]:
    name = "" if frame is None else f"{NAMES[frame.can_id]} [{frame.data.hex(' ')}]"
    match option[0]:
        case "tick":
            asked = [] if option[1] is Event.NONE else [f"asked: {option[1].name}"]
            asked += [f"the law wants {option[2]}"] if option[2] != LEVELS[0] else []
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


def _fault(kind: str, frame: Frame, tick: int) -> str:
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
        _, event, counts, trips = option
        return "tick", Event(int(str(event))), tuple(counts), trips  # type: ignore[arg-type]
    return tuple(option)
