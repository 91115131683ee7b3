"""What can go wrong: every target with its kinds of fault, their parameters, defaults and ranges.

A fault lives where the physical thing is: sense and amplifier channels at the node and plant, bus faults on the wire, a
late tick in the controller's clock. Nothing of this is known to the controller.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple


class Parameter(NamedTuple):
    """A number of a fault: its default, its range (ends included) and what it is."""

    default: float
    low: float
    high: float
    meaning: str


class Kind(NamedTuple):
    """A kind of fault: what it does, and its parameters by name."""

    meaning: str
    parameters: Mapping[str, Parameter] = MappingProxyType({})


_SHARE = Parameter(1.0, 0.0, 1.0, "probability for each frame")

KINDS: Final[dict[str, dict[str, Kind]]] = {
    "sense": {
        "off": Kind("reads no capacitance at all: the converter is at its lower rail"),
        "stuck": Kind("repeats the value that it had"),
        "garbage": Kind("random counts over the whole range"),
        "wrong_gain": Kind("shows a multiple of the stroke", {"gain": Parameter(1.2, 0.0, 10.0, "of the stroke")}),
        "offset": Kind("shows a stroke too much", {"offset_m": Parameter(2e-6, -20e-6, 20e-6, "of the stroke")}),
        "slow": Kind("a first-order filter in the way", {"corner_hz": Parameter(20.0, 0.1, 5e3, "its corner")}),
        "delayed": Kind("samples of some SYNCs ago", {"samples": Parameter(4, 1, 100, "how many")}),
        "intermittent": Kind(
            "a loose contact: off in some samples", {"probability": Parameter(0.8, 0.0, 1.0, "for each sample")}
        ),
        "noise_burst": Kind("much noise", {"sigma_m": Parameter(3e-6, 0.0, 20e-6, "rms of the stroke")}),
    },
    "amplifier": {
        "stuck": Kind("keeps the voltage that it had, whatever is commanded"),
        "dead": Kind("gives 0 V"),
        "offset": Kind("adds a voltage", {"offset_v": Parameter(30.0, -200.0, 200.0, "added")}),
        "slew_collapse": Kind(
            "follows slowly", {"slew_v_per_s": Parameter(300.0, 1.0, 1e5, "most that the output changes")}
        ),
        "trip": Kind(
            "reports over-current and discharges all combs", {"code": Parameter(0x2310, 1, 0xFEFF, "of EMCY")}
        ),
        "saturated": Kind("gives no more than a voltage", {"voltage_v": Parameter(60.0, 0.0, 200.0, "at most")}),
    },
    "node": {
        "silent": Kind("its transmitter is dead; it still listens"),
        "reset": Kind("a brown-out: it starts anew, its combs at 0 V"),
        "reboot_loop": Kind("starts anew again and again", {"interval_s": Parameter(0.005, 0.001, 10.0, "between")}),
        "wrong_identity": Kind(
            "another device in its place: it starts with another product code",
            {"product_code": Parameter(0x99, 0, 0xFFFFFFFF, "object 0x1018:2")},
        ),
        "wrong_configuration": Kind(
            "another master writes one of its objects by SDO: at first, that it answer every second SYNC only",
            {
                "index": Parameter(0x1801, 0, 0xFFFF, "of the object"),
                "subindex": Parameter(2, 0, 255, "of the object"),
                "value": Parameter(2, 0, 0xFFFFFFFF, "that is written"),
                "bytes": Parameter(1, 1, 4, "how many it has"),
            },
        ),
    },
    "bus": {
        "drop": Kind("frames are not delivered, and nobody notices", {"probability": _SHARE}),
        "duplicate": Kind("frames are delivered twice", {"probability": _SHARE}),
        "reorder": Kind("frames of a kind change places in pairs"),
        "corrupt": Kind("a bit of the payload is flipped behind the bus's back", {"probability": _SHARE}),
        "delay": Kind("frames are delivered late", {"delay_us": Parameter(250, 1, 1e6, "how late")}),
        "error_frames": Kind(
            "frames are destroyed by error frames and repeated, until their sender is bus-off", {"probability": _SHARE}
        ),
        "forged": Kind(
            "another node sends the very next frame of a kind, counter and CRC right; of no kind: NMT stop",
            {"interval_s": Parameter(0.0005, 0.0001, 10.0, "between")},
        ),
        "babbling": Kind("another node sends without a pause", {"identifier": Parameter(1, 0, 0x7FF, "of its frames")}),
    },
    "controller": {
        "late_tick": Kind("ticks begin late", {"late_us": Parameter(60, 1, 1e6, "how late")}),
        "lost_tick": Kind("nothing happens for some ticks", {"ticks": Parameter(20, 1, 1e6, "how many")}),
        "killed": Kind("the program ends without a word"),
    },
    "plant": {
        "stiffness": Kind("all flexures change", {"factor": Parameter(1.5, 0.2, 5.0, "of their stiffness")}),
        "snap": Kind("the table is pulled against a stop", {"force_n": Parameter(-10e-3, -0.1, 0.1, "along z")}),
        "shock": Kind("a knock", {"force_n": Parameter(2e-3, -0.1, 0.1, "along x; 2 mN are 40 g")}),
    },
}

PARTS: Final[dict[str, tuple[str, ...]]] = {
    "sense": ("1", "2", "3"),
    "amplifier": ("1", "2", "3"),
    "bus": ("sense", "drive", "sync", "heartbeat"),
}
"""Behind the dot of a target: ``sense.2``, ``bus.drive``. ``bus`` alone is every frame; the others have no parts."""

_WHOLE: Final = {("bus", "babbling")}
"""Kinds that a part of their target can't have."""


def refusal(target: str, kind: str, parameters: dict[str, float]) -> str | None:
    """Why there is no such fault, with what there is; None if there is."""
    family, dot, part = target.partition(".")
    if family not in KINDS:
        return f"no target is called {target!r}; there are {', '.join(targets())}"
    needs_part = family in ("sense", "amplifier")
    if (dot and part not in PARTS.get(family, ())) or (needs_part and not dot):
        known = ", ".join(t for t in targets() if t.partition(".")[0] == family)
        return f"no target is called {target!r}; there are {known}"
    if kind not in KINDS[family] or (dot and (family, kind) in _WHOLE):
        return f"{target} has no fault {kind!r}; it has {', '.join(KINDS[family])}"
    known_parameters = KINDS[family][kind].parameters
    for name, value in parameters.items():
        if name not in known_parameters:
            has = ", ".join(known_parameters) or "none"
            return f"{target}:{kind} has no parameter {name!r}; it has: {has}"
        parameter = known_parameters[name]
        if not parameter.low <= value <= parameter.high:
            return f"{target}:{kind}: {name} = {value:g} is not within {parameter.low:g} to {parameter.high:g}"
    return None


def targets() -> list[str]:
    """Every target, in order."""
    names: list[str] = []
    for family in KINDS:
        if family not in ("sense", "amplifier"):
            names.append(family)
        names += [f"{family}.{part}" for part in PARTS.get(family, ())]
    return names
