"""What may be asked of a stage in operation, and how it answers: records that cross between processes."""

from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.operate.law_change import NAME_BYTES
from pkxyz_ctrl.loop.row import ROW


class Verb(IntEnum):
    """What may be asked."""

    HOME = 1
    ENABLE = 2
    DISABLE = 3
    MOVE = 4
    JOG = 5
    PATH = 6
    PAUSE = 7
    RESUME = 8
    ABORT = 9
    STOP = 10
    PARK = 11
    CLEAR = 12
    AUTO_ZERO = 13
    SETTLE = 14
    LIMITS = 15
    RELEASE = 16
    SAMPLE = 17
    QUIET = 18
    LAW = 19
    TRIGGER = 20


MEANING: Final[dict[Verb, str]] = {
    Verb.HOME: "average the sense offsets at rest, at 0 V",
    Verb.ENABLE: "close the loop; the stage holds the rest pose",
    Verb.DISABLE: "open the loop: 0 V",
    Verb.MOVE: "go to a point, or by a way; a new target in flight is taken up without a stop",
    Verb.JOG: "go along an axis as long as this is said again within the lease",
    Verb.PATH: "follow a path that is streamed, from its first point on",
    Verb.PAUSE: "stop on the path, without leaving it",
    Verb.RESUME: "go on along the path",
    Verb.ABORT: "end what runs: stop on the path, then hold",
    Verb.STOP: "stop by the shortest way and hold, whatever runs",
    Verb.PARK: "go to the rest pose, then open the loop",
    Verb.CLEAR: "forget the fault and start the amplifier again",
    Verb.AUTO_ZERO: "park, home, and back to where the stage held",
    Verb.SETTLE: "the window and dwell by which the stage is in position",
    Verb.LIMITS: "velocity, acceleration and jerk of moves that name none",
    Verb.SAMPLE: "where the sample lies: targets and positions are in its coordinates from now on",
    Verb.QUIET: "quiet holds: less noise and less rejection while the set-point stands; or no longer",
    Verb.LAW: "another law, taken over without a jump; while the stage holds, or is off",
    Verb.TRIGGER: "positions along an axis at which the node's digital outputs pulse; no longer, with a count of 0",
    Verb.RELEASE: "0 V at once, whatever runs; a fault that has to be cleared",
}


class State(IntEnum):
    """Where a command stands. The last three are final."""

    ACCEPTED = 1
    RUNNING = 2
    DONE = 3
    REFUSED = 4
    ABORTED = 5


FINAL: Final = frozenset({State.DONE, State.REFUSED, State.ABORTED})


class Activity(IntEnum):
    """What the stage is doing, for a person."""

    STARTING = 0
    OFF = 1
    HOMING = 2
    HOLDING = 3
    MOVING = 4
    JOGGING = 5
    SCANNING = 6
    PAUSED = 7
    STOPPING = 8
    FAULT = 9


ACTIVITY_WORDS: Final[dict[Activity, str]] = {
    Activity.STARTING: "starting the amplifier",
    Activity.OFF: "off: 0 V, loop open",
    Activity.HOMING: "homing: averaging the sense offsets at 0 V",
    Activity.HOLDING: "holding its set-point",
    Activity.MOVING: "moving",
    Activity.JOGGING: "jogging",
    Activity.SCANNING: "following a path",
    Activity.PAUSED: "paused on its path",
    Activity.STOPPING: "coming to a stop",
    Activity.FAULT: "fault: 0 V, latched until cleared",
}

COMMAND = np.dtype(
    [
        ("id", "<u8"),  # of the command, chosen by who writes it; larger than every earlier one
        ("verb", "<i4"),
        ("relative", "<i4"),  # MOVE: 1 for a way, 0 for a point
        ("target_m", "<f8", (3,)),  # MOVE: NaN leaves an axis where its target is. JOG: direction, one of them not 0.
        # PATH: where it ends, in the stage's coordinates
        ("velocity_m_per_s", "<f8"),  # 0 for the limits in force
        ("acceleration_m_per_s2", "<f8"),
        ("jerk_m_per_s3", "<f8"),
        ("window_m", "<f8"),  # SETTLE
        ("dwell_s", "<f8"),
        ("sigmas", "<f8"),
        ("matrix", "<f8", (3, 4)),  # SAMPLE, as of ``SampleAxes.matrix``
        ("on", "<i4"),  # QUIET
        ("law", "<u8"),  # LAW: number of the one that was offered
        ("axis", "<i4"),  # TRIGGER: of the stage, 0 to 2 ...
        ("direction", "<i4"),
        ("first_m", "<f8"),
        ("pitch_m", "<f8"),
        ("count", "<i8"),
        ("path", "<u8"),  # PATH: number of the path whose rows are streamed ...
        ("rows", "<u8"),  # ... and how many it has
        ("start_m", "<f8", (3,)),  # ... and where it begins, in the stage's coordinates
    ],
    align=True,
)

ANSWER = np.dtype(
    [
        ("id", "<u8"),  # of the command; 0 for what nobody asked: a fault
        ("verb", "<i4"),
        ("state", "<i4"),
        ("t_us", "<i8"),
        ("words", "S1000"),  # UTF-8
    ],
    align=True,
)

SESSION = np.dtype(
    [
        ("activity", "<i4"),
        ("in_position", "<i4"),
        ("homed", "<i4"),
        ("running_id", "<u8"),  # of the command that moves the stage, 0 for none
        ("target_m", "<f8", (3,)),  # where the motion ends, a path too, in the stage's coordinates
        ("matrix", "<f8", (3, 4)),  # of the sample's coordinates, as of ``SampleAxes.matrix``
        ("uncertainty_m", "<f8", (3,)),  # standard deviation of the estimate
        ("law", f"S{NAME_BYTES}"),
        ("progress", "<f8"),  # 0..1 of a path
        ("path_row", "<f8"),  # where on the path, in its rows; NaN off it
        ("commands", "<u8"),  # taken out of the memory so far
        ("missed", "<i8"),  # ticks, since the loop began, in which somebody waited for one
        ("stood_us", "<i8"),  # for so long time stood still, as a stage that is simulated waits for the computer
        ("frames", "<i8"),  # sent and received
        ("wire_ns", "<i8"),  # that these took on the wire; a frame as long as the first of its length
    ],
    align=True,
)

TICK = np.dtype([("row", ROW), ("session", SESSION)], align=True)
"""What a loop in operation tells of each tick."""

PATH_ROWS = 64
PATH_BLOCK = np.dtype(
    [
        ("path", "<u8"),
        ("first", "<u8"),
        ("count", "<u8"),
        ("motion", "<f8", (PATH_ROWS, 9)),
        ("output", "<i4", (PATH_ROWS,)),
    ],
    align=True,
)
"""Rows of a path, as ``Trajectory.sample`` and ``Trajectory.outputs`` give them."""


def new_command(verb: Verb, command_id: int) -> NDArray[np.void]:
    """A command (1,) that says nothing but its verb."""
    command = np.zeros(1, COMMAND)
    command["verb"], command["id"] = int(verb), command_id
    command["target_m"] = np.nan
    return command
