"""The numbers that the wire's two inputs tell the monitors, by bit."""

from pkxyz_ctrl.safety.monitors import NodeEvent, SenseStatus

STATUS = {
    SenseStatus.MISSING: ("no valid sense PDO since the last SYNC; the counts are the last valid ones", "no"),
    SenseStatus.COUNTER: (
        "counter not one more than the last, or not matching the SYNCs",
        "if it is *n* more (after a loss); if it is late or replayed, no",
    ),
    SenseStatus.CRC: ("a frame with a wrong CRC came", "no"),
    SenseStatus.LENGTH: ("a frame of a wrong length came", "no"),
    SenseStatus.DUPLICATE: ("a second valid frame in one tick, repeated or not yet due", "the first"),
    SenseStatus.IMPLAUSIBLE: ("a good frame with a stroke that is not believed; the cycle sets it", "no"),
}
"""What was wrong with a tick's sense frame, and whether its value is used."""

EVENTS = {
    NodeEvent.HEARTBEAT_LOST: ("no heartbeat for longer than `node_heartbeat_timeout_ms`", "`start()`"),
    NodeEvent.NOT_OPERATIONAL: ("the heartbeat says another state", "`start()`"),
    NodeEvent.REBOOTED: ("a boot-up message came", "`start()`"),
    NodeEvent.EMERGENCY: ('an EMCY other than "error reset" came', "`acknowledge()` or `start()`"),
    NodeEvent.FOREIGN_FRAME: (
        "a frame came that only this controller may send; `foreign` names the first",
        "`start()`",
    ),
    NodeEvent.SAFETY_OBJECTS: ("the node's signature of its safety objects is another one, or stays away", "`start()`"),
}
"""What the supervision of the node saw, and what clears it."""


def statuses() -> str:
    """A row for each bit of ``sense_status``."""
    return _table("meaning | value used", STATUS)


def events() -> str:
    """A row for each bit of ``node_events``."""
    return _table("set when | cleared by", EVENTS)


def _table(header: str, told: dict[SenseStatus, tuple[str, str]] | dict[NodeEvent, tuple[str, str]]) -> str:
    rows = [f"| {int(bit)} | {bit.name} | {words} | {then} |" for bit, (words, then) in told.items()]
    return "\n".join([f"| bit | name | {header} |", "| --- | --- | --- | --- |", *rows])
