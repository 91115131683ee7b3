"""What is explored: sizes, identifiers, how much may go wrong, and the start-up as short as it may be."""

from dataclasses import dataclass
from typing import Final

from pkxyz_ctrl.can import startup
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.safety.trips import Trip

PERIOD_US = 20_000
TURNAROUND_US = 0
POLL_US = 5_000
HEARTBEAT_TIMEOUT_MS = 55  # two lost ones, as with the shipped 20 and 50 ms, and the half tick that the first may take
NODE_BEATS_WITH_ROOM = 45, 95  # ms: every other tick has one, as it goes along with a sense PDO; one may be lost
STEP = 10  # counts that may be added in a tick
LEVELS: tuple[Counts, ...] = ((0, 0, 0), (10, 10, 0), (20, 20, 10))  # each a permitted step from its neighbour
TOO_FAR: tuple[Counts, ...] = ((0, 20, 20), (21, 20, 10))  # a comb that drops beyond the slew limit; beyond the maximum
MAXIMUM = 20
SOFT, HARD = Trip.OPERATOR, Trip.COMB_FORCE_1  # led down, and at once
SETTLED = 2  # ticks, before the loop is closed
NODE_ID, CONTROLLER_ID = 10, 127
LATE_TICKS = 2  # how long a frame may be held back
SIGNATURE_SYNCS = 2  # from one signature to the next
PERMITTED_BITS = 0x1F  # of the digital outputs

NMT, SYNC, EMCY, SENSE, DRIVE, REPLY, REQUEST = 0x000, 0x080, 0x08A, 0x28A, 0x30A, 0x58A, 0x60A
OUTPUTS, SIGNATURE = 0x20A, 0x38A
NODE_BEAT, OUR_BEAT = 0x70A, 0x77F
NAMES = {
    NMT: "NMT", SYNC: "SYNC", EMCY: "emergency", SENSE: "sense", DRIVE: "drive", REPLY: "SDO answer",
    OUTPUTS: "outputs", SIGNATURE: "signature", REQUEST: "SDO request",
    NODE_BEAT: "heartbeat of the node", OUR_BEAT: "heartbeat of the controller",
}  # fmt: skip
FROM_US = frozenset({NMT, SYNC, DRIVE, OUTPUTS, REQUEST, OUR_BEAT})
CUTS = {
    "SYNC": frozenset({SYNC}),
    "drive": frozenset({DRIVE}),
    "controller": FROM_US,
    "node": frozenset({EMCY, SENSE, SIGNATURE, REPLY, NODE_BEAT}),
    "outputs": frozenset({OUTPUTS}),
    "signature": frozenset({SIGNATURE}),
}
"""What may stop to get through until somebody mends it: one fault, however long it lasts."""


@dataclass(frozen=True)
class Configuration:
    """What is explored: sizes, and how much may go wrong."""

    name: str
    faults: int
    drive_timeout_syncs: int = 3
    drive_timeout_ms: int = 50
    whole_dialogue: bool = False  # all SDO steps of the start-up, not one of each sort
    kinds: frozenset[str] = frozenset({"late", "repeat", "damage", "skip", "cut"})
    levels: tuple[Counts, ...] = (*LEVELS, *TOO_FAR)  # what the law may want
    outputs: tuple[int, ...] = (0,)  # what it may want of the digital outputs; only 0: nobody asks for them
    has_signature: bool = False  # the node signs its safety objects at work
    by_hand: bool = False  # it takes longer than a change should have to wait
    settle_ticks: int = 4  # within so many ticks of a decision all combs are at 0 V
    agree_ticks: int = 4  # so long may combs hold something else than the gate believes, before it stops to believe

    @property
    def has_outputs(self) -> bool:
        """Whether the digital outputs are asked for."""
        return any(self.outputs)

    @property
    def has_room(self) -> bool:
        """Whether some ticks are without heartbeats of the node, and so have room for what is not in each of them."""
        return self.has_outputs or self.has_signature

    @property
    def cuts(self) -> tuple[str, ...]:
        """Of `CUTS`, those that make a difference."""
        without = {"outputs": not self.has_outputs, "signature": not self.has_signature}
        return tuple(cut for cut in CUTS if "cut" in self.kinds and not without.get(cut, False))


BITS: Final = (0, 1, PERMITTED_BITS + 1)  # low, high, and what nobody may set
FEW: Final = (LEVELS[0], LEVELS[1], (21, 20, 10))
ANY: Final = frozenset({"late", "repeat", "damage", "skip"})
CONFIGURATIONS: Final = {
    c.name: c
    for c in (
        Configuration("well", 0, kinds=frozenset()),
        Configuration("one", 1),
        Configuration("two", 2),
        Configuration("three", 3, kinds=ANY),
        Configuration(
            "slow drive time-out", 1, drive_timeout_syncs=5, drive_timeout_ms=90, settle_ticks=6, agree_ticks=6
        ),
        Configuration("whole dialogue", 1, kinds=ANY, whole_dialogue=True),
        Configuration("outputs, well", 0, kinds=frozenset(), levels=FEW, outputs=BITS),
        Configuration("outputs", 1, levels=FEW, outputs=BITS),
        Configuration("signature, well", 0, kinds=frozenset(), levels=FEW, has_signature=True, whole_dialogue=True),
        Configuration("signature", 1, levels=FEW, has_signature=True, whole_dialogue=True),
        Configuration("outputs and signature", 1, levels=FEW, outputs=BITS, has_signature=True, whole_dialogue=True),
        Configuration("outputs, two", 2, kinds=ANY, levels=FEW, outputs=BITS, by_hand=True),
    )
}
"""Every kind of fault; what it costs decides how many at a time. ``late`` covers
loss: what is held back may never be let go."""


OF_EACH_SORT = {0x2010: (0,), 0x2011: (0,), 0x2012: (0,), 0x1016: (1,), 0x1017: (0,), 0x1019: (0,)}


_OUTPUTS = (0x1400, 0x1600, 0x6200)  # all of them, or the node is taken for one without


def few_settings(config: DriverConfig, count_step_max: int) -> tuple[startup.Setting, ...]:
    """Of the shipped settings, in their order, the identity and those that change what the node does from then on; what
    the others ask for is the default of the EDS, so nothing of it is written. The dialogue treats all alike, and
    remembers nothing of one but its answer.
    """
    return tuple(
        setting
        for setting in startup.table(config, count_step_max)
        if setting.index in (0x1000, 0x1018, *_OUTPUTS) or setting.subindex in OF_EACH_SORT.get(setting.index, ())
    )


def bus_of(configuration: Configuration) -> BusConfig:
    shipped = load("buses", "fd_5k", BusConfig)
    assert shipped.can is not None
    node_period_ms, node_timeout_ms = NODE_BEATS_WITH_ROOM if configuration.has_room else (20, HEARTBEAT_TIMEOUT_MS)
    driver = DriverConfig(
        digital_outputs=configuration.has_outputs,
        signature_syncs=SIGNATURE_SYNCS if configuration.has_signature else 0,
        controller_heartbeat_timeout_ms=HEARTBEAT_TIMEOUT_MS,
        node_heartbeat_period_ms=node_period_ms,
        node_heartbeat_timeout_ms=node_timeout_ms,
        drive_timeout_syncs=configuration.drive_timeout_syncs,
        drive_timeout_ms=configuration.drive_timeout_ms,
        boot_timeout_us=50_000,
        start_timeout_us=50_000,
        sdo_timeout_us=30_000,
        retries=1,
    )
    can = shipped.can.model_copy(update={"driver": driver})
    return shipped.model_copy(update={"period_us": PERIOD_US, "can": can})
