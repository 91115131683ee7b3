"""The verbs that take time, each as a generator that is resumed once a tick and returns what was reached, in words."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.operate import law_change
from hil.operate.loop import Loop
from hil.operate.path_stream import NEAR_M, PathStream
from hil.operate.reach import Reach
from hil.operate.setpoints import Setpoints
from hil.operate.settings import Settings
from pkxyz_ctrl.loop.law_change import change_to
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, MODE_FACTS, Event, Mode, refusal
from pkxyz_ctrl.trajectory import TrajectoryError
from pkxyz_ctrl.trajectory.segments import Limits

Array = NDArray[np.float64]
Steps = Generator[None, None, str]
"""Yields until the next tick; returns the words of what is done."""

_REST = np.zeros(3)
_SETTLES_S, _STARTS_S = 2.0, 10.0
_BUFFERED_ROWS = 512  # of a path, before it is begun
_AXES = "xyz"
_LISTENS_S = 0.05  # a new law, before it acts
_CALM_S, _CALM_DEVIATIONS = 0.2, 0.25  # for so long at most it waits for a tick whose force is as near to its mean
_CHANGES_S = 2.0  # a law that comes too late for so long is not changed


class RefusedError(Exception):
    """Nothing was done; the message says why, and what to do instead."""


class AbortedError(Exception):
    """Begun, but not brought to its end; the message says why."""


@dataclass
class Operated:
    """What procedures work on."""

    controller: Loop
    setpoints: Setpoints
    reach: Reach
    settings: Settings
    period_s: float
    law_name: bytes = b""
    path: PathStream | None = None
    """that is being followed"""
    said: str = ""
    """what a procedure has to tell before its end"""
    passed: int = 0
    """ticks, since the beginning"""

    @property
    def mode(self) -> int:
        """A ``Mode``: the controller's, after the last tick."""
        return self.controller.mode

    @property
    def is_driven(self) -> bool:
        """Whether the loop is closed."""
        return bool(LOOP_CLOSED[self.mode])

    @property
    def is_homed(self) -> bool:
        """Whether the sense offsets are known."""
        return bool(self.controller.memory["homed"][0])

    @property
    def is_in_position(self) -> bool:
        """Whether the estimate has been within the window of the target for the dwell, and the set-point is there."""
        ticks = int(self.controller.outputs["position"]["ticks"][0])
        return self.setpoints.has_arrived and 0 < ticks >= int(self.controller.outputs["dwell_ticks"][0])

    def where(self, position_m: Array) -> str:
        """A position (3,) of the stage in words: where on the sample."""
        return _um(self.reach.turn.to_sample(position_m))

    def ticks(self, seconds: float) -> Iterator[int]:
        """Ticks from now on, as they pass, for a time: 0, and at each step how many it were."""
        begin, most = self.passed, round(seconds / self.period_s)
        while (age := self.passed - begin) < most:
            yield age

    def require_holding(self, what: str) -> None:
        """Raise ``RefusedError`` unless the loop is closed and follows."""
        if self.mode != Mode.TRACKING:
            raise RefusedError(f"{what} needs a closed loop, and it is {_mode_words(self.mode)}: home, then enable")


def home(stage: Operated) -> Steps:
    """Average the sense offsets at rest."""
    if stage.mode != Mode.IDLE:
        raise RefusedError(_not_now(stage.mode, Event.HOME, "disable or park first"))
    stage.controller.request(Event.HOME)
    yield
    while stage.mode == Mode.HOMING:
        yield
    if not stage.is_homed or stage.mode != Mode.IDLE:
        raise AbortedError(f"homing was broken off: {_mode_words(stage.mode)}")
    return "the sense offsets are known"


def enable(stage: Operated) -> Steps:
    """Close the loop at rest, as soon as the combs have been at 0 V for long enough."""
    if stage.mode == Mode.TRACKING:
        return "the loop is closed already"
    if stage.mode not in (Mode.IDLE, Mode.ENABLED):
        raise RefusedError(_not_now(stage.mode, Event.ENABLE, "clear the fault first"))
    if not stage.is_homed:
        raise RefusedError("the sense offsets are not known yet: home first")
    for _ in stage.ticks(_SETTLES_S):
        if stage.mode != Mode.IDLE:
            break
        stage.controller.request(Event.ENABLE)
        yield
    if stage.mode != Mode.ENABLED:
        raise AbortedError(f"the loop did not close: {_mode_words(stage.mode)}")
    stage.setpoints.restart(_REST)
    stage.controller.request(Event.TRACK)
    yield
    if stage.mode != Mode.TRACKING:
        raise AbortedError(f"the loop did not stay closed: {_mode_words(stage.mode)}")
    return "the loop is closed and holds the rest pose"


def disable(stage: Operated) -> Steps:
    """Lead the stage down and open the loop: 0 V."""
    if stage.mode == Mode.FAULT:
        raise RefusedError("the combs are at 0 V already, by a fault: clear it")
    for _ in stage.ticks(_SETTLES_S):
        if stage.mode == Mode.IDLE:
            return "the loop is open, the combs are at 0 V"
        stage.controller.request(Event.DISABLE)
        yield
    raise AbortedError(f"the loop did not open: {_mode_words(stage.mode)}")


def move(stage: Operated, target_m: Array, limits: Limits) -> Steps:
    """To a point (3,), and until the stage is in position there."""
    stage.require_holding("a move")
    yield from _lead(stage, target_m, limits)
    for n in stage.ticks(stage.settings.settle_s):
        if stage.is_in_position:
            return f"in position at {stage.where(target_m)}, {n * stage.period_s * 1e3:.1f} ms after the set-point"
        yield
    window_nm, dwell_ms = stage.settings.window_m * 1e9, stage.settings.dwell_s * 1e3
    raise AbortedError(
        f"the set-point is at {stage.where(target_m)}, but the stage has not been within {window_nm:g} nm of it for "
        f"{dwell_ms:g} ms in {stage.settings.settle_s:g} s: widen the window, or look for what disturbs it"
    )


def jog(stage: Operated, direction: Array, limits: Limits, lease: "Lease") -> Steps:
    """Along one axis, as far as the combs hold, until the lease ends."""
    stage.require_holding("a jog")
    axis = int(np.argmax(np.abs(direction)))
    here = stage.setpoints.state()[0]
    far_m = stage.reach.farthest(here, axis, float(direction[axis])) * 0.999
    if far_m < 1e-9:
        raise RefusedError(
            f"the stage is at the end of what the combs hold along {_AXES[axis]}, at {stage.where(here)}"
        )
    target = here + stage.reach.turn.way_to_stage(np.sign(direction) * far_m)
    _set_out(stage, target, limits)
    while lease.lasts and not stage.setpoints.has_arrived:
        _require_set_out(stage)
        yield
    _require_set_out(stage)
    if stage.setpoints.has_arrived:
        return f"at the end of what the combs hold along {_AXES[axis]}"
    stage.setpoints.brake(stage.settings.limits)
    while not stage.setpoints.has_arrived:
        yield
    return f"stands at {stage.where(stage.setpoints.target_m)}: {lease.why}"


class Lease:
    """How long a jog may go on: until somebody ends it, or nobody has renewed it for too long."""

    def __init__(self, until_us: int) -> None:
        self.until_us = until_us
        self.why = ""

    @property
    def lasts(self) -> bool:
        """Whether the jog may go on."""
        return not self.why

    def look(self, now_us: int) -> None:
        """End it if it is time."""
        if now_us > self.until_us:
            self.end("the lease was not renewed")

    def end(self, why: str) -> None:
        """No longer."""
        self.why = self.why or why


def follow(stage: Operated, path: PathStream) -> Steps:
    """To the first point of a path, then along it, and until the stage is in position at its end."""
    stage.require_holding("a path")
    if (why := stage.reach.target_refusal(path.end_m)) is not None:
        raise RefusedError(f"the path's end: {why}")
    if float(np.abs(stage.setpoints.state()[0] - path.start_m).max()) > NEAR_M or not stage.setpoints.has_arrived:
        yield from move(stage, path.start_m, stage.settings.limits)
    stage.path = path
    for _ in stage.ticks(_STARTS_S):
        if path.objection is not None:
            raise AbortedError(path.objection)
        if path.has(min(path.rows, _BUFFERED_ROWS)):
            break
        yield
    else:
        raise AbortedError("the rows of the path did not come")
    stage.setpoints.follow(path, path.end_m)
    yield
    while not stage.setpoints.has_arrived:
        if stage.setpoints.runs_short and not stage.setpoints.is_stopping:
            stage.setpoints.stop_on_path()
            stage.said = "paused, as the next rows of the path have not come in time: resume once they have"
        if path.objection is not None and stage.setpoints.stands_on_path:
            raise AbortedError(path.objection)
        yield
    for _ in stage.ticks(stage.settings.settle_s):
        if stage.is_in_position:
            break
        yield
    return f"the path has been followed to its end, {path.rows + 1} set-points"


def pause(stage: Operated) -> Steps:
    """Stop on the path."""
    if stage.setpoints.has_arrived or not stage.is_driven:
        raise RefusedError("nothing moves that could be paused")
    stage.setpoints.stop_on_path()
    yield
    while stage.is_driven and not stage.setpoints.stands_on_path:
        yield
    return f"stands on its path at {stage.where(stage.setpoints.state()[0])}"


def resume(stage: Operated) -> Steps:
    """Go on along the path."""
    if not stage.is_driven or not stage.setpoints.is_stopping:
        raise RefusedError("nothing is paused")
    if stage.setpoints.runs_short:
        raise RefusedError("the next rows of the path have not come yet: ask again, or abort")
    stage.setpoints.go_on()
    yield
    return "goes on along its path"


def halt(stage: Operated, *, on_path: bool) -> Steps:
    """To rest: on the path, or by the shortest way; then hold there."""
    if not stage.is_driven:
        return "nothing moves"
    if on_path and not stage.setpoints.has_arrived:
        stage.setpoints.stop_on_path()
        yield
        while stage.is_driven and not (stage.setpoints.stands_on_path or stage.setpoints.has_arrived):
            yield
        stage.setpoints.leave_path()
    elif not stage.setpoints.has_arrived:
        stage.setpoints.brake(stage.settings.limits)
        yield
        while stage.is_driven and not stage.setpoints.has_arrived:
            yield
    return f"stands at {stage.where(stage.setpoints.target_m)} and holds" if stage.is_driven else "the loop is open"


def park(stage: Operated) -> Steps:
    """To the rest pose, in position there or not, then 0 V."""
    if stage.mode == Mode.TRACKING:
        yield from _lead(stage, _REST, stage.settings.limits)
    yield from disable(stage)
    return "parked: at rest, the combs are at 0 V"


def auto_zero(stage: Operated) -> Steps:
    """Measure the sense offsets anew, and go back to where the stage held."""
    was_driven, back_m = stage.is_driven, stage.setpoints.target_m.copy()
    yield from park(stage)
    yield from home(stage)
    if not was_driven:
        return "the sense offsets are known"
    yield from enable(stage)
    yield from move(stage, back_m, stage.settings.limits)
    return f"the sense offsets are known anew; back at {stage.where(back_m)}"


def clear(stage: Operated) -> Steps:
    """Forget the fault, and start the amplifier again."""
    if stage.mode != Mode.FAULT and stage.mode >= Mode.IDLE:
        raise RefusedError("there is no fault to clear")
    for _ in stage.ticks(_STARTS_S):
        if stage.mode == Mode.IDLE:
            return "the fault is cleared; home, then enable"
        stage.controller.clear()
        yield
    raise AbortedError(f"the amplifier did not come back in {_STARTS_S:g} s: {stage.controller.faults[-1:]}")


def change_law(stage: Operated, offered: np.void) -> Steps:
    """To a law, a record of ``law_change.OFFER``, without a jump."""
    controller, name = stage.controller, offered["name"].decode()
    new = np.array([offered["law"]])
    new["autostart"] = controller.law["autostart"]
    if (why := law_change.objection(controller.law, new)) is not None:
        raise RefusedError(f"{name}: {why}")
    heard = law_change.Listening(new, controller.memory)
    change = change_to(new, heard.x, adapts_alike=law_change.adapts_alike(controller.law, new))
    for _ in stage.ticks(_CHANGES_S):
        yield from _listened(stage, heard)
        change["x"] = heard.x
        controller.change_law(change)
        if not controller.is_obeyed:
            yield
            heard.listen(controller.passed())
        if controller.is_obeyed:
            stage.law_name = offered["name"]
            return f"the law is {name}"
    raise AbortedError("the law came too late again and again, and is as it was: free the machine, and ask again")


def _listened(stage: Operated, heard: law_change.Listening) -> Generator[None, None, None]:
    """Until the law that listens may act."""
    least, calm = (round(s / stage.period_s) if stage.is_driven else 0 for s in (_LISTENS_S, _CALM_S))
    for _ in stage.ticks(_CHANGES_S):
        if heard.ticks >= least and (heard.ticks >= least + calm or heard.is_calm(_CALM_DEVIATIONS)):
            break
        yield
        heard.listen(stage.controller.passed())
    if stage.mode not in (Mode.IDLE, Mode.TRACKING):
        raise AbortedError("the stage no longer held")


def _lead(stage: Operated, target_m: Array, limits: Limits) -> Generator[None, None, None]:
    """The set-point to a point (3,)."""
    _set_out(stage, target_m, limits)
    while not stage.setpoints.has_arrived:
        _require_set_out(stage)
        yield
    _require_set_out(stage)


def _require_set_out(stage: Operated) -> None:
    """Raise ``AbortedError`` where the set-point could not set out after all."""
    if stage.setpoints.objection is not None:
        raise AbortedError(stage.setpoints.objection)


def _set_out(stage: Operated, target_m: Array, limits: Limits) -> None:
    """Raise ``RefusedError`` where the combs can't hold the target or follow on the way, before anything moves."""
    if (why := stage.reach.target_refusal(target_m)) is not None:
        raise RefusedError(why)
    try:
        stage.setpoints.go(target_m, limits, stage.reach.motion_refusal)
    except TrajectoryError as error:
        raise RefusedError(str(error)) from None


def _not_now(mode: int, event: Event, remedy: str) -> str:
    return f"{refusal(Mode(mode), event) or _mode_words(mode)}; {remedy}"


def _mode_words(mode: int) -> str:
    return f"{Mode(mode).name} ({MODE_FACTS[Mode(mode)].meaning})"


def _um(position_m: Array) -> str:
    return f"({', '.join(f'{round(v * 1e6, 4) + 0.0:g}' for v in position_m)}) um"
