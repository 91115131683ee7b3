"""From NMT reset to a node that may be driven: who is it, what does it hold, does it notice when we are gone?

No clock, no socket: messages in, messages out, time passed in. ``AmplifierDriver`` makes frames of them.
"""

from collections.abc import Callable

from . import cob_id, startup
from .cob_id import NmtCommand, NmtState
from .driver_config import DriverConfig
from .driver_rules import DriverState
from .sdo import SdoDialogue, SdoStep
from .startup import Found, Key, Plan, identity_steps

Message = tuple[int, bytes]
Messages = tuple[Message, ...]

_NOTHING: Messages = ()
_NEVER_US = 1 << 62


class StartSequence:
    """The start-up of one node; ``state`` runs from RESETTING to OPERATIONAL or FAILED.

    In IDENTIFYING the node says who it is, in CONFIGURING what it holds; what differs is written, and everything that
    has to hold is read once more. Once it is operational, at 0 V, our heartbeat stays away: in TRYING a node has to
    leave that state by itself. One that has done so, or of which a report says so, is known by identity and serial
    number and not tried again. ``lost`` tells which protections it does without.
    """

    def __init__(
        self,
        config: DriverConfig,
        count_step_max: int,
        survey: Callable[[DriverConfig], tuple[SdoStep, ...]] = startup.survey,
        plan: Callable[[DriverConfig, int, Found], Plan] = startup.plan,
    ) -> None:
        """``survey``: what is asked first; ``plan``: what is done about the answers."""
        self._survey, self._plan = survey, plan
        self.state = DriverState.OFF
        self.failure = ""
        self.lost: tuple[str, ...] = ()
        self.sync_overflow = cob_id.SYNC_COUNTER_OVERFLOW  # 0: a SYNC without counter
        self._config = config
        self._count_step_max = count_step_max
        self._name = f"amplifier (node {config.node_id})"
        self._heartbeat = cob_id.HEARTBEAT_BASE + config.controller_node_id, bytes((NmtState.OPERATIONAL,))
        self._dialogue = SdoDialogue((), 0, 0)
        self._is_planned = False  # the dialogue is that of what was planned, not the survey before it
        self._deadline_us = _NEVER_US
        self._repeats_left = 0
        self._never_booted = ""
        self._node_state: int | None = None
        self._found: dict[Key, int | None] = {}
        self._identity: tuple[int | None, ...] = ()
        self._is_tried = False
        self._times_left = 0
        self._tried_identity: tuple[int | None, ...] = ()

    def begin(self, t_us: int) -> Messages:
        """Reset the node, from any state."""
        self.failure = self._never_booted = ""
        self.lost = ()
        self._node_state = None
        self._repeats_left = self._config.retries
        return self._reset(t_us)

    def poll(self, t_us: int) -> Messages:
        """Time-outs and repetitions."""
        if self.state in (DriverState.IDENTIFYING, DriverState.CONFIGURING):
            return self._advance(self._dialogue.poll(t_us), t_us)
        if t_us < self._deadline_us:
            return _NOTHING
        if self.state is DriverState.RESETTING:
            return self._boot_timed_out(t_us)
        if self.state is DriverState.STARTING:
            return self._start_timed_out(t_us)
        return self._trial_timed_out() if self.state is DriverState.TRYING else _NOTHING

    def answer(self, data: bytes, t_us: int) -> Messages:
        """An SDO answer of the node's."""
        if self.state not in (DriverState.IDENTIFYING, DriverState.CONFIGURING):
            return _NOTHING
        return self._advance(self._dialogue.receive(data, t_us), t_us)

    def heartbeat(self, node_state: int, t_us: int) -> Messages:
        """A heartbeat of the node's."""
        self._node_state = node_state
        if node_state == NmtState.BOOT_UP:
            return self._boot_up(t_us)
        if self.state is DriverState.STARTING and node_state == NmtState.OPERATIONAL:
            return self._started(t_us)
        return self._left_or_not(node_state, t_us) if self.state is DriverState.TRYING else _NOTHING

    # -- reset ------------------------------------------------------------------------------------------------------

    def _reset(self, t_us: int) -> Messages:
        self.state = DriverState.RESETTING
        self._deadline_us = t_us + self._config.boot_timeout_us
        return (self._nmt(NmtCommand.RESET_NODE),)

    def _boot_timed_out(self, t_us: int) -> Messages:
        """After the last try the node is asked all the same: its boot-up message may have been missed."""
        if self._repeats_left > 0:
            self._repeats_left -= 1
            return self._reset(t_us)
        self._never_booted = (
            f"{self._name} sent no boot-up message 0x{cob_id.HEARTBEAT_BASE + self._config.node_id:03X} within "
            f"{self._config.boot_timeout_us / 1000:g} ms of NMT reset, {self._config.retries + 1} times"
        )
        return self._identify(t_us)

    def _boot_up(self, t_us: int) -> Messages:
        if self.state is DriverState.RESETTING:
            return self._identify(t_us)
        self._never_booted = ""
        if self._repeats_left > 0:  # late answer to a repeated reset: what was written is lost
            self._repeats_left -= 1
            return self._identify(t_us)
        return self._fail(f"{self._name} restarts again and again while it is configured; check its power supply")

    # -- dialogue ---------------------------------------------------------------------------------------------------

    def _identify(self, t_us: int) -> Messages:
        """A node that starts by itself (CiA 302-2, object 1F80h) is not configured while it is operational."""
        self.state = DriverState.IDENTIFYING
        self._deadline_us = _NEVER_US
        self._found = {}
        return self._nmt(NmtCommand.PRE_OPERATIONAL), *self._ask(identity_steps(self._config), t_us)

    def _ask(self, steps: tuple[SdoStep, ...], t_us: int) -> Messages:
        self._dialogue = SdoDialogue(steps, self._config.sdo_timeout_us, self._config.retries)
        return self._sdo(self._dialogue.begin(t_us))

    def _advance(self, requests: tuple[bytes, ...], t_us: int) -> Messages:
        dialogue = self._dialogue
        if dialogue.failure:
            if self._never_booted and not dialogue.is_begun:
                return self._fail(f"{self._never_booted}; check node id, power, wiring and bit rates")
            return self._fail(f"{self._name}: {dialogue.failure}", *self._sdo(requests))
        if not dialogue.done:
            return self._sdo(requests)
        if self.state is DriverState.IDENTIFYING:
            self.state, self._is_planned = DriverState.CONFIGURING, False
            self._found = dict(dialogue.values)
            return self._ask(self._survey(self._config), t_us)
        if not self._is_planned:
            return self._configure(t_us)
        overflow = dialogue.values.get((0x1019, 0), self._found.get((0x1019, 0))) or 0
        if overflow == 1 or overflow > cob_id.SYNC_COUNTER_OVERFLOW:
            return self._fail(
                f"{self._name} counts SYNCs to {overflow} (0x1019), CiA 301 permits 2 to 240; see its manual"
            )
        self.sync_overflow = overflow
        self._repeats_left = self._config.retries
        return self._start(t_us)

    def _configure(self, t_us: int) -> Messages:
        self._is_planned = True
        self._found = self._found | self._dialogue.values
        self._identity = tuple(self._found.get((0x1018, part)) for part in (1, 2, 3, 4))
        planned = self._plan(self._config, self._count_step_max, self._found)
        missed = (f"{self._never_booted}: that it answers, and what it holds, was seen instead",)
        self.lost = (*(missed if self._never_booted else ()), *planned.lost)
        if planned.refusal:
            return self._fail(f"{self._name}: {planned.refusal}")
        is_known = None not in self._identity and self._identity == self._tried_identity
        self._is_tried = planned.is_proven or is_known
        return self._ask(planned.steps, t_us)

    # -- start and trial --------------------------------------------------------------------------------------------

    def _start(self, t_us: int) -> Messages:
        self.state = DriverState.STARTING
        self._deadline_us = t_us + self._config.start_timeout_us
        return self._heartbeat, self._nmt(NmtCommand.START)

    def _started(self, t_us: int) -> Messages:
        if self._is_tried:
            self.state = DriverState.OPERATIONAL
            self._deadline_us = _NEVER_US
            return _NOTHING
        self.state = DriverState.TRYING
        self._times_left = 0
        self._deadline_us = t_us + 1000 * self._trial_ms
        return _NOTHING

    def _left_or_not(self, node_state: int, t_us: int) -> Messages:
        """It has left once it says so twice: one heartbeat may be damaged, late, or somebody else's."""
        self._times_left = self._times_left + 1 if node_state != NmtState.OPERATIONAL else 0
        if self._times_left < 2:
            return _NOTHING
        self._is_tried, self._tried_identity = True, self._identity
        self._repeats_left = self._config.retries
        return self._start(t_us)

    def _start_timed_out(self, t_us: int) -> Messages:
        if self._repeats_left > 0:
            self._repeats_left -= 1
            return self._start(t_us)[1:]
        return self._fail(
            f"{self._name} did not become operational within {self._config.start_timeout_us / 1000:g} ms of NMT start, "
            f"{self._config.retries + 1} times: {self._heard}; look at its emergencies",
            self._nmt(NmtCommand.PRE_OPERATIONAL),
        )

    def _trial_timed_out(self) -> Messages:
        return self._fail(
            f"{self._name} did not notice that our heartbeat ended: {self._trial_ms} ms later {self._heard}. "
            "It may store 0x1016 and 0x1029 and do nothing with them: it would hold its combs at a voltage for ever",
            self._nmt(NmtCommand.PRE_OPERATIONAL),
        )

    def disturbed(self, by: str) -> Messages:
        """Somebody speaks in our name while the node is operational and we are silent: it goes back at once."""
        return self._fail(by, self._nmt(NmtCommand.PRE_OPERATIONAL))

    # -- small things -----------------------------------------------------------------------------------------------

    @property
    def _trial_ms(self) -> int:
        """The node's consumer, and then two heartbeats of its own."""
        config = self._config
        return (
            config.controller_heartbeat_timeout_ms + config.node_heartbeat_period_ms + config.node_heartbeat_timeout_ms
        )

    @property
    def _heard(self) -> str:
        return "no heartbeat came" if self._node_state is None else f"its heartbeat says {state_name(self._node_state)}"

    def _fail(self, failure: str, *last: Message) -> Messages:
        self.failure = failure
        self.state = DriverState.FAILED
        self._deadline_us = _NEVER_US
        return last

    def _nmt(self, command: NmtCommand) -> Message:
        return cob_id.NMT, bytes((command, self._config.node_id))

    def _sdo(self, requests: tuple[bytes, ...]) -> Messages:
        return tuple((cob_id.SDO_REQUEST_BASE + self._config.node_id, data) for data in requests)


def state_name(node_state: int) -> str:
    """``pre-operational``: what a heartbeat's number means."""
    try:
        return NmtState(node_state).name.lower().replace("_", "-")
    except ValueError:
        return f"unknown state 0x{node_state:02X}"
