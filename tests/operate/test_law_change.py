"""Another law while the stage holds: the true position is not kicked; what can't be taken over is refused."""

import numpy as np
import pytest
from operated_rig import MIDDLE_M, OperatedRig, Script, raster_rows

from hil.operate.commands import State, Verb
from hil.operate.law_change import OFFER
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law_store import law_of

NAN = np.nan


def offered(rig: OperatedRig, name: str) -> int:
    offer = np.zeros(1, OFFER)
    controller = load("controllers", name, ControllerConfig)
    offer["number"], offer["name"] = len(rig.rows) + 1, name.encode()
    offer["law"] = law_of(rig.setup.stage, controller, rig.setup.bus, autostart=False)
    rig.session.offer(offer[0])
    return int(offer["number"][0])


@pytest.mark.parametrize("plant", ["nominal", "mild"])
def test_laws_follow_one_another_without_a_kick(plant):
    """Out of the middle, where the feedback holds up to 1e-5 N: each law begins with the force of the one before. What
    is left is what each law makes of its own noise.
    """
    rig = OperatedRig(load_scenario("raster", controller="youla", plant=plant, bus="fd_5k").setup())
    names = ("lqg", "irc", "robust", "youla", "pi_notch", "irc_robust", "lqg", "youla")
    at: list[int] = []

    def script() -> Script:
        yield from rig.switched_on()
        assert (yield from rig.do(Verb.MOVE, target_m=(4e-6, -3e-6, 22e-6))) is State.DONE
        for name in names:
            yield from rig.wait_s(0.08)
            change = rig.give(Verb.LAW, law=offered(rig, name))
            yield from rig.until_final(change)
            assert rig.words_of(change) == f"the law is {name}"
            at.append(len(rig.rows))
        yield from rig.wait_s(0.08)
        assert rig.session.state["law"][0].decode() == "youla"
        assert (yield from rig.do(Verb.MOVE, target_m=MIDDLE_M)) is State.DONE

    rows = rig.play(script())
    assert not rig.controller.faults
    for begin, name in zip(at, names, strict=True):
        held, after = rows["position_m"][begin - 200 : begin - 2], rows["position_m"][begin - 2 : begin + 60]
        kick_m = np.abs(after - held.mean(0)).max()
        assert kick_m < 5e-9, (name, kick_m)  # peaks of 3 to 4 nm are what the laws' own holds have
        assert rows["reference_m"][begin, 0] == 4e-6


def test_what_holds_is_changed_and_nothing_else():
    rig = OperatedRig()
    path, start = raster_rows()

    def refused(name: str, words: str) -> Script:
        command = rig.give(Verb.LAW, law=offered(rig, name))
        yield from rig.until_final(command)
        assert rig.state_of(command) is State.REFUSED
        assert words in rig.words_of(command)

    def script() -> Script:
        assert (yield from rig.do(Verb.LAW, law=offered(rig, "lqg"))) is State.DONE, "off"
        assert (yield from rig.do(Verb.LAW, law=offered(rig, "youla"))) is State.DONE, rig.answers
        yield from rig.switched_on()
        yield from refused("open_loop", "no feedback that could take over")
        yield from refused("mpc", "plans beside the tick")
        command = rig.give(Verb.LAW, law=123456)
        yield from rig.until_final(command)
        assert "did not come" in rig.words_of(command)
        rig.give(Verb.MOVE, target_m=(3e-6, NAN, NAN))
        yield from rig.wait_s(0.004)
        yield from refused("lqg", "MOVE (command 9) is running: wait for it, or abort it first")
        yield from rig.wait_s(0.05)
        number = rig.give(Verb.PATH, path=7, rows=len(path), start_m=start, target_m=path[-1, 0:3])
        rig.every_tick.append(lambda: rig.session.wants_rows and feed())
        yield from rig.wait_s(0.08)
        yield from refused("lqg", "is running: wait for it")
        yield from rig.do(Verb.ABORT)
        assert rig.state_of(number) is State.ABORTED
        assert (yield from rig.do(Verb.LAW, law=offered(rig, "lqg"))) is State.DONE

    sent = [0]

    def feed() -> None:
        rows = path[sent[0] : sent[0] + 64]
        rig.session.take_rows(7, sent[0], rows, np.zeros(len(rows), np.int32))
        sent[0] += 64

    rig.play(script())
    assert not rig.controller.faults


def test_quiet_holds_are_asked_for_and_no_longer():
    rig = OperatedRig()
    at: list[int] = []

    def script() -> Script:
        yield from rig.switched_on()
        for on in (1, 0):
            at.append(len(rig.rows))
            assert (yield from rig.do(Verb.QUIET, on=on)) is State.DONE
            yield from rig.wait_s(0.02)

    rows = rig.play(script())
    assert rows["quiet"][at[0] + 5 : at[1] - 5].all()
    assert not rows["quiet"][at[1] + 5 :].any()
