"""Every kind of fault once, with what has to come of it: who notices, how soon, and what the combs do meanwhile.

Times in a case count from the first tick; the scan has been at mid-workspace for 60 ms by then. A fault that nobody can
notice from inside says why, and is held to what is safe.
"""

from typing import Final, NamedTuple

from hil.faults.fault import Fault, parse
from pkxyz_ctrl.safety.trips import Trip

ONSET_S: Final = 0.22
LASTS_S: Final = 0.02
USUAL_PERIOD_US: Final = 200
"""Of the bus that the bounds are stated for."""
CLEAR_S: Final = 0.05
"""How long after the fault decision somebody clears it: the fault itself is over by then."""

DEFAULT_WITHIN_TICKS: Final = 5


class Case(NamedTuple):
    """A fault and what it has to lead to."""

    text: str
    """as for ``parse``, without its time"""
    reasons: Trip
    """one of these has to be among those latched; none: it can't be noticed"""
    within_ticks: int = DEFAULT_WITHIN_TICKS
    note: str = ""
    """why later than the default, or not at all"""
    obeys: tuple[bool, bool, bool] = (True, True, True)
    """which combs still do what the node tells them"""
    discharged_within_ms: float | None = None
    """where 0 V can't be sent: how soon the node goes there by itself; None: by the controller, within two ticks"""
    may_go_on: bool = False
    """not noticing it is as good, since it does no harm"""
    forged_v: float = 0.0
    """what somebody else may make of 0 V for a tick or two, until the node has been taken out of operational again"""
    lasts_s: float | None = LASTS_S
    """None: to the end"""
    reasons_if_lasting: Trip = Trip(0)
    """or one of these, where it never ends"""

    @property
    def fault(self) -> Fault:
        """At its time."""
        head, comma, rest = self.text.partition(",")
        lasts = "" if self.lasts_s is None else f"+{self.lasts_s}"
        return parse(f"{head}@{ONSET_S}{lasts}{comma}{rest}")

    @property
    def lasting(self) -> "Case":
        """The same, and it never ends."""
        return self._replace(lasts_s=None, reasons=self.reasons | self.reasons_if_lasting)

    def on(self, period_us: int) -> "Case":
        """The same at another period than the usual one: what is late is so by the same share of it; and where three
        ticks are a longer way for the stage, several strokes are implausible at once, or other ones.
        """
        if period_us == USUAL_PERIOD_US:
            return self
        head, _, rest = self.text.partition(",")
        late = {"bus.sense:delay": ",delay_us", "bus.drive:delay": ",delay_us", "controller:late_tick": ",late_us"}
        share = {"": 1.25, "late_us=90": 0.6, "late_us=30": 0.15}
        text = f"{head}{late[head]}={round(share[rest] * period_us)}" if head in late else self.text
        reasons = self.reasons | (_MOVED | _MISFIT | _FORCE if self.reasons & (_MOVED | _MISFIT | _FORCE) else NOTHING)
        return self._replace(text=text, reasons=reasons)


_STALE = Trip.SENSE_STALE
_MISFIT = Trip.COMB_MISFIT_1 | Trip.COMB_MISFIT_2 | Trip.COMB_MISFIT_3
_FORCE = Trip.COMB_FORCE_1 | Trip.COMB_FORCE_2 | Trip.COMB_FORCE_3
_MOVED = Trip.INNOVATION_X | Trip.INNOVATION_Y | Trip.INNOVATION_Z
_SMALL = "no more than an imperfect device shows"
_THREE_OF_EIGHT = "three wild samples, of which four in five are wild"
_LAG = "speed times delay, 0.2 um, is no more than an imperfect device shows; noticed if the loop swings over it"
_ASKED = "nothing to see until the scan asks comb 2 to move: 25 ticks (stuck), 30 (slow), sooner by the feedback"
_HARDLY_ASKED = "this scan asks too little of comb 1"
_FOLLOWS_SLOWLY = "34 ticks likewise: 0.06 V a tick against the 0.2 V that are asked"
_HEARTBEAT = "50 ms after the last heartbeat; counted PDOs come all the while"
_WHICH = "which of two is right nobody can tell; four in short order are a fault"
_CHANNEL_2 = Trip.COMB_FORCE_2 | Trip.COMB_MISFIT_2
_CHANNEL_1 = Trip.COMB_FORCE_1 | Trip.COMB_MISFIT_1
_NODE = Trip.HEARTBEAT_LOST | Trip.NODE_EMERGENCY | Trip.NODE_NOT_OPERATIONAL
NOTHING: Final = Trip(0)
NODE_MS: Final = 21.0
"""The node's time without an applied drive PDO (0x2012), and the look a millisecond later."""

CASES: Final[tuple[Case, ...]] = (
    Case("sense.1:off", Trip.SENSE_RANGE_1 | Trip.COMB_MISFIT_1),
    Case("sense.2:stuck", Trip.SENSE_FROZEN_2 | _MISFIT | _FORCE, 50, "50 equal counts, or sooner where it matters"),
    Case("sense.3:garbage", Trip.SENSE_RANGE_3 | Trip.COMB_MISFIT_3),
    Case("sense.1:wrong_gain", Trip.COMB_MISFIT_1),
    Case("sense.2:wrong_gain,gain=1.02", NOTHING, note=_SMALL, may_go_on=True),
    Case("sense.3:offset", Trip.COMB_MISFIT_3),
    Case("sense.1:offset,offset_m=0.2e-6", NOTHING, note=_SMALL, may_go_on=True),
    Case("sense.2:slow", _MISFIT | _FORCE, 33, _ASKED, lasts_s=0.04),
    Case("sense.3:delayed", _MISFIT | _FORCE | _MOVED, 100, _LAG, may_go_on=True),
    Case("sense.1:intermittent", Trip.SENSE_RANGE_1 | Trip.COMB_MISFIT_1, 8, _THREE_OF_EIGHT),
    Case("sense.2:noise_burst", Trip.COMB_MISFIT_2 | Trip.SENSE_RANGE_2, 8, _THREE_OF_EIGHT),
    Case("amplifier.2:stuck", _CHANNEL_2, 28, _ASKED, (True, False, True)),
    Case("amplifier.1:stuck", _CHANNEL_1, 250, _HARDLY_ASKED, (False, True, True), may_go_on=True, lasts_s=0.05),
    Case("amplifier.2:dead", Trip.COMB_FORCE_2 | Trip.COMB_MISFIT_2),
    Case("amplifier.3:offset", Trip.COMB_FORCE_3 | Trip.COMB_MISFIT_3, obeys=(True, True, False)),
    Case("amplifier.2:slew_collapse", _CHANNEL_2, 37, _FOLLOWS_SLOWLY, (True, False, True), lasts_s=0.04),
    Case("amplifier.2:trip", Trip.NODE_EMERGENCY, 2),
    Case("amplifier.3:saturated", Trip.COMB_FORCE_3 | Trip.COMB_MISFIT_3, obeys=(True, True, False)),
    Case("node:silent", _STALE),
    Case("node:reset", _STALE | Trip.NODE_REBOOTED),
    Case("node:reboot_loop", _STALE | Trip.NODE_REBOOTED),
    Case("node:wrong_identity", _STALE | Trip.NODE_REBOOTED),
    Case("node:wrong_configuration", Trip.FOREIGN_FRAME, 1),
    Case("node:wrong_configuration,index=4101,subindex=0,value=144,bytes=4", Trip.FOREIGN_FRAME, 1),  # SYNC: 0x1005
    Case("bus:drop", _STALE, discharged_within_ms=NODE_MS),
    Case("bus.sense:drop", _STALE),
    Case("bus.drive:drop", Trip.NODE_EMERGENCY),
    Case("bus.sync:drop", _STALE),
    Case("bus.heartbeat:drop", _NODE, 251, _HEARTBEAT, lasts_s=0.06),
    Case("bus.sense:duplicate", Trip.SENSE_SEQUENCE),
    Case("bus.drive:duplicate", Trip.NODE_EMERGENCY, 2),
    Case("bus.sense:reorder", Trip.SENSE_SEQUENCE),
    Case("bus.sense:corrupt", Trip.SENSE_CRC | _STALE),
    Case("bus.drive:corrupt", Trip.NODE_EMERGENCY, 2),
    Case("bus.sense:delay", _STALE),
    Case("bus.drive:delay", Trip.NODE_EMERGENCY),
    Case(
        "bus.sense:error_frames", _STALE | Trip.NODE_EMERGENCY, discharged_within_ms=NODE_MS
    ),  # drive frames wait, too
    Case("bus:error_frames", _STALE, discharged_within_ms=NODE_MS),
    Case("bus:forged", Trip.FOREIGN_FRAME, 1),
    Case("bus.sync:forged", Trip.FOREIGN_FRAME | Trip.NODE_EMERGENCY, 2),
    Case("bus.drive:forged", Trip.FOREIGN_FRAME | Trip.NODE_EMERGENCY, 2, forged_v=8.0),
    Case("bus.heartbeat:forged", Trip.FOREIGN_FRAME, 1),
    Case("bus.sense:forged", Trip.SENSE_SEQUENCE | _STALE | Trip.NODE_EMERGENCY, 15, _WHICH),
    Case("bus:babbling", _STALE, discharged_within_ms=NODE_MS),
    Case(
        "controller:late_tick,late_us=30",
        NOTHING,
        note="within what the bus has to spare",
        may_go_on=True,
        reasons_if_lasting=Trip.NODE_EMERGENCY,  # but for our heartbeats, which then never fit in before the next SYNC
    ),
    Case("controller:late_tick,late_us=90", _STALE | Trip.OVERRUN, note="answers come after the deadline"),
    Case("controller:lost_tick", Trip.OVERRUN | _STALE),
    Case("controller:killed", NOTHING, note="nobody is left to notice; the node is", discharged_within_ms=NODE_MS),
    Case("plant:stiffness", _MISFIT | _FORCE | _MOVED),
    Case("plant:snap", _MOVED | _MISFIT),
    Case("plant:shock", _MOVED | _MISFIT),
)
