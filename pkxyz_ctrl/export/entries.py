"""What of the compiled kernels gets a name in C, and what each is handed."""

from typing import Any, Final, NamedTuple

import numpy as np

from pkxyz_ctrl.export import planned
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop import exchange, law_change
from pkxyz_ctrl.loop.reference import REFERENCE

ONE, MANY, FIELD, RECORD = range(4)
"""How a kernel takes records: an array of one, an array of any number, the one-element field of a record, the record
itself. A cycle that takes fields is the very one that ``period`` calls, so that it is compiled once.
"""


class Argument(NamedTuple):
    """Records, by a pointer to the first and, if there may be many, their number; or a number, ``c_type`` in C.
    ``whole``: what the kernel takes where that is more than C knows of.
    """

    name: str
    dtype: np.dtype[np.void] | None = None
    is_const: bool = False
    kind: int = ONE
    c_type: str = "int64_t"
    whole: np.dtype[np.void] | None = None

    @property
    def taken(self) -> np.dtype[np.void] | None:
        """The record that the kernel takes."""
        return self.dtype if self.whole is None else self.whole


class Entry(NamedTuple):
    """A kernel, and its name in C; there it returns a status, 0 if all is well. ``told``: the kernel's own answer goes
    where a last argument points to.
    """

    name: str
    kernel: Any
    arguments: tuple[Argument, ...]
    about: str
    told: bool = True


_CONFIG = Argument("config", exchange.EXCHANGE, is_const=True)
_MEMORY = Argument("memory", exchange.EXCHANGE_MEMORY)
_PATH = Argument("reference", REFERENCE, is_const=True, kind=MANY)
_T_US = Argument("t_us")
_NUMBERS: Final = tuple(Argument(name, c_type="int32_t") for name in ("can_id", "flags", "length"))
_OUT = "Leaves frames in memory->driver[0].out, told: their number, 256 where one was refused"

ENTRIES = (
    Entry(
        "pkxyz_switch_on",
        exchange.switch_on,
        (_MEMORY,),
        "Once, with a memory of zeros: nothing has been sent or received.",
        told=False,
    ),
    Entry("pkxyz_start", exchange.start, (_CONFIG, _MEMORY, _T_US), f"The start-up begins. {_OUT}."),
    Entry(
        "pkxyz_wait",
        exchange.wait,
        (_CONFIG, _MEMORY, _T_US),
        f"During the start-up, a millisecond or so after the last frame. {_OUT}.",
    ),
    Entry(
        "pkxyz_come_up",
        exchange.come_up,
        (_MEMORY,),
        "During the start-up, after pkxyz_wait and pkxyz_on_frame. told: 1, periods may begin; -1, it failed; else 0.",
    ),
    Entry(
        "pkxyz_begin",
        exchange.begin,
        (_CONFIG, _MEMORY, _T_US),
        f"A period begins: SYNC, and what else is due. {_OUT}; 512 and 1024 where the start-up after a clear began and "
        "failed.",
    ),
    Entry(
        "pkxyz_on_frame",
        exchange.on_frame,
        (_CONFIG, _MEMORY, *_NUMBERS, Argument("data"), _T_US),
        "Each frame that comes, data its first eight bytes, the first lowest. told: 1 once this period's sense values "
        "are in, 4 where the start-up has left frames in memory->driver[0].out.",
    ),
    Entry(
        "pkxyz_period",
        exchange.period,
        (_CONFIG, _MEMORY, _PATH, Argument("overrun", c_type="int32_t")),
        "The cycle, after overrun periods that were skipped. The record is memory->cycle[0].row. told: the mode that "
        "was left, -1 if it stays.",
    ),
    Entry(
        "pkxyz_finish",
        exchange.finish,
        (_CONFIG, _MEMORY, _T_US, Argument("heartbeat_until_us")),
        f"The drive frame of this period, for the next SYNC, and our heartbeat if it is due and fits. {_OUT}.",
    ),
    Entry(
        "pkxyz_prepare",
        exchange.prepare,
        (_CONFIG, _MEMORY),
        "Behind the drive frame: what it did not have to wait for. Left out, the next period begins with it.",
        told=False,
    ),
    Entry("pkxyz_stop", exchange.stop, (_CONFIG, _MEMORY, _T_US), f"0 V and pre-operational. {_OUT}."),
    Entry(
        "pkxyz_judge",
        exchange.judge,
        (_CONFIG._replace(kind=RECORD), _MEMORY._replace(kind=RECORD), Argument("first"), _T_US),
        f"The gate, for frames of your own behind the first so many in memory->driver[0].out. {_OUT}.",
    ),
    Entry(
        "pkxyz_cycle",
        cycling.cycle,
        (
            Argument("law", cycling.LAW, is_const=True, kind=FIELD),
            Argument("memory", cycling.MEMORY, kind=FIELD),
            _PATH,
        ),
        "What pkxyz_period calls: reads memory->input, leaves counts for the combs, mode and record in memory->row.",
        told=False,
    ),
)

OF_LOOP = (
    Entry("pkxyz_ask_to_clear", exchange.ask_to_clear, (_MEMORY,), "The fault is to be forgotten.", told=False),
    Entry(
        "pkxyz_take_over",
        law_change.take_over,
        (
            Argument("law", cycling.LAW),
            Argument("memory", cycling.MEMORY),
            Argument("change", law_change.CHANGE, is_const=True),
        ),
        "Between two periods, the stage at rest or its loop open: another law takes over.",
        told=False,
    ),
)
"""What the native loop calls besides; no board has it."""


_PLANNED = {
    "pkxyz_period": (planned.period, {"config": planned.PLANNED_EXCHANGE, "memory": planned.PLANNED_EXCHANGE_MEMORY}),
    "pkxyz_cycle": (planned.cycle, {"law": planned.PLANNED_LAW, "memory": planned.PLANNED_MEMORY}),
}


def entries_for(*, has_loop: bool, is_planned: bool = False) -> tuple[Entry, ...]:
    """Those that a target has, with the native loop, which takes any law, or without; there also for one that plans."""
    entries = tuple(_planned(entry) for entry in ENTRIES) if has_loop or is_planned else ENTRIES
    return entries + OF_LOOP if has_loop else entries


def _planned(entry: Entry) -> Entry:
    if entry.name not in _PLANNED:
        return entry
    kernel, whole = _PLANNED[entry.name]
    arguments = tuple(argument._replace(whole=whole.get(argument.name)) for argument in entry.arguments)
    return entry._replace(kernel=kernel, arguments=arguments)
