"""The controller between frames that a test hands in and those that it sends: no bus, no clock, no run."""

import numpy as np
import pytest
from loop_rig import setup
from scripted_node import BOOT_UP, OPERATIONAL, PRE_OPERATIONAL, ObedientServer, frame, heartbeat, text

from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.core.linear_law import ORDER_MAX
from pkxyz_ctrl.loop import controller as controller_module
from pkxyz_ctrl.loop.controller import Controller, StartUpError, part
from pkxyz_ctrl.loop.law_change import change_to
from pkxyz_ctrl.loop.outputs import OUTPUTS
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.trips import Trip

SETUP = setup()
LAW = SETUP.law  # designed once, before any test
RESET, SYNC_1, OURS = "000 81 0a", "080 01", "77f 05"
EMERGENCY = "08a 10 23 03 00 00 00 00 00"
FAR_US = 10**9


class Rig:
    """A controller, what it has sent, and a server that does as it is told."""

    def __init__(self) -> None:
        self.sent: list[Frame] = []
        self.discarded: list[int] = []
        self.server = ObedientServer()
        self.controller = Controller(
            LAW, SETUP.bus, SETUP.gate, self.sent.append, lambda: self.discarded.append(len(self.sent)),
            lambda: "; the plug is out",
        )  # fmt: skip
        self.now_us = 0

    @property
    def memory(self) -> np.void:
        return self.controller.exchange[0]

    def taken(self) -> list[str]:
        """What was sent since somebody looked last."""
        found, self.sent[:] = text(tuple(self.sent)), []
        return found

    def dialogue(self, received: Frame) -> bool:
        return self.controller.dialogue(received, self.now_us)

    def come_up(self) -> "Rig":
        self.controller.start(0)
        assert not self.dialogue(heartbeat(BOOT_UP))
        while self.sent[-1].can_id == 0x60A:
            assert not self.dialogue(self.server.answer(self.sent[-1]))
        for state in (OPERATIONAL, PRE_OPERATIONAL, PRE_OPERATIONAL):
            assert not self.dialogue(heartbeat(state))
        assert self.dialogue(heartbeat(OPERATIONAL))
        assert self.controller.mode == Mode.IDLE
        self.taken()
        return self

    def tick(self, *received: Frame, overrun: int = 0) -> list[str]:
        """A whole period; what it sent."""
        self.now_us += SETUP.bus.period_us
        self.controller.begin(self.now_us)
        for each in received:
            self.controller.receive(each, self.now_us)
        self.controller.compute(standing_still(), overrun)
        self.controller.finish(self.now_us, self.now_us + 100)
        return self.taken()


def sense(counter: int = 1, counts: tuple[int, int, int] = (1, -2, 3)) -> Frame:
    return Frame(0x28A, ProcessCodec(0x28A, True).encode(counts, counter), True, True)


# -- before there are periods ------------------------------------------------------------------------------------------


def test_a_controller_needs_a_bus_with_frames() -> None:
    with pytest.raises(ValueError, match=r"has no \[can\]"):
        Controller(LAW, SETUP.bus.model_copy(update={"can": None}), SETUP.gate, print)


def test_it_comes_up_with_a_node_that_does_as_it_is_told() -> None:
    rig = Rig().come_up()
    assert not rig.controller.has_outputs
    rig.memory["driver"][0]["has_outputs"] = 1
    assert rig.controller.has_outputs
    assert rig.controller.is_obeyed is True
    assert [memory is rig.controller.memory for memory in rig.controller.passed()] == [True]
    rig.controller.stop(100)
    assert [words[:3] for words in rig.taken()] == ["30a", "000"]


def test_where_no_frame_comes_the_start_goes_on_by_time_until_it_fails() -> None:
    rig = Rig()
    rig.controller.start(0)
    assert rig.taken() == [RESET]
    assert rig.controller.dialogue(None, FAR_US) is False
    assert rig.taken() == [RESET]
    with pytest.raises(StartUpError, match=r"sent no boot-up message.*; the plug is out$"):
        [rig.controller.dialogue(None, time * FAR_US) for time in range(2, 99)]


def test_a_start_up_frame_that_the_gate_holds_back_ends_it() -> None:
    rig = Rig()
    rig.controller.start(0)
    rig.controller.memory["mode"] = Mode.TRACKING
    rig.taken()
    with pytest.raises(StartUpError, match="blocked in TRACKING: NMT_RESET is not permitted now"):
        rig.controller.dialogue(None, FAR_US)
    assert rig.taken() == []
    assert rig.controller.faults[-1].startswith("frame 0x000 [81 0a] blocked in TRACKING")


def test_a_start_forgets_the_emergencies_of_before() -> None:
    rig = Rig().come_up()
    rig.controller.receive(frame(EMERGENCY), 5)
    assert len(rig.controller.driver.emergencies) == 1
    rig.controller.start(10)
    assert len(rig.controller.driver.emergencies) == 0


# -- what is asked for -------------------------------------------------------------------------------------------------


def test_what_is_asked_for_stands_where_the_cycle_reads_it() -> None:
    controller = Controller(LAW, SETUP.bus, SETUP.gate, print)
    controller.request(Event.HOLD)
    assert controller.exchange["event"][0] == Event.HOLD
    for quiet in (True, False):
        controller.hold_quietly(quiet)
        assert controller.memory["input"]["quiet"][0] == quiet
    controller.memory["input"]["trips"] = Trip.SLEW
    controller.release()
    assert controller.memory["input"]["trips"][0] == Trip.SLEW | Trip.OPERATOR
    controller.settle(20e-9, 3.0, 7.0 * SETUP.bus.period_us * 1e-6)
    outputs = controller.outputs[0]
    assert (outputs["window_m"], outputs["sigmas"], outputs["dwell_ticks"]) == (20e-9, 3.0, 7)
    controller.aim(1, -1, 2e-6, 3e-7, 4)
    trigger = outputs["trigger"]
    assert [trigger[name] for name in ("axis", "direction", "start_m", "pitch_m", "count")] == [1, -1, 2e-6, 3e-7, 4]
    controller.memory["mode"] = Mode.FAULT
    controller.clear()
    assert controller.exchange["clearing"][0] == 1
    controller.missed_ticks = 5
    assert controller.missed_ticks == controller.exchange["missed_ticks"][0] == 5


@pytest.mark.parametrize(
    "reference",
    [standing_still().repeat(0), standing_still().reshape(1, 1), np.zeros((1, 9)), standing_still().repeat(4)[::2]],
)
def test_what_is_no_reference_is_refused_and_not_remembered(reference: np.ndarray) -> None:
    controller = Controller(LAW, SETUP.bus, SETUP.gate, print)
    for _ in range(2):
        with pytest.raises(ValueError, match="reference"):
            controller.compute(reference, 0)
    assert controller.memory["tick_index"][0] == 0
    controller.compute(standing_still().repeat(3), 0)
    assert controller.memory["tick_index"][0] == 1


# -- periods -----------------------------------------------------------------------------------------------------------


def test_a_period_takes_what_came_and_sends_what_is_to_be_sent() -> None:
    rig = Rig().come_up()
    told = rig.tick(sense())
    assert told[0] == SYNC_1
    assert told[1].startswith("30a 00 00 00 00 00 00 00 ")
    assert len(told) == 2
    row = rig.controller.memory["row"][0]
    assert row["sense_count"].tolist() == [1, -2, 3]
    assert rig.controller.missed_ticks == 0
    assert rig.tick(overrun=2)
    assert rig.controller.missed_ticks == 3


def test_a_frame_is_told_fresh_and_a_short_one_is_looked_at_too() -> None:
    rig = Rig().come_up()
    rig.controller.begin(200)
    assert rig.controller.receive(frame("123 01 02"), 210) is False
    assert rig.controller.receive(heartbeat(OPERATIONAL), 215) is False
    assert rig.controller.receive(frame(EMERGENCY), 220) is False
    assert len(rig.controller.driver.emergencies) == 1
    assert rig.controller.receive(sense(), 230) is True
    for length in (9, 12):
        assert rig.controller.receive(Frame(0x28A, bytes(length), True, True), 240) is True


def test_our_heartbeat_goes_out_whole_behind_the_voltages() -> None:
    rig = Rig().come_up()
    rig.memory["driver"][0]["heartbeat_next_us"] = 100
    rig.controller.receive(frame("08a 00 00 00 00 00 00 00 00"), 5)
    told = rig.tick(sense())
    assert (len(told), told[2]) == (3, OURS)
    assert len(rig.controller.driver.emergencies) == 1, "as long as nothing starts anew"


def test_a_fault_is_told_with_all_that_is_known_of_it_and_what_waits_is_discarded() -> None:
    rig = Rig().come_up()
    rig.tick(sense())
    rig.tick(sense(2), frame(EMERGENCY), frame("080 07"))
    assert rig.controller.mode == Mode.FAULT
    (fault,) = rig.controller.faults
    assert fault.startswith("at 0.0002 s: ")
    assert "(NODE_EMERGENCY)" in fault
    assert "[0x080 [07], a SYNC that this controller did not send" in fault
    assert "\nEMCY 0x2310: current, output side" in fault
    assert fault.endswith("; the plug is out")
    assert rig.discarded == [1], "behind the SYNC, before the 0 V"
    rig.tick()
    assert len(rig.controller.faults) == len(rig.discarded) == 1


def test_a_fault_before_there_is_a_node_is_told_as_well() -> None:
    rig = Rig()
    assert rig.controller.mode == Mode.BOOT
    rig.controller.release()
    rig.controller.compute(standing_still(), 0)
    assert rig.controller.mode == Mode.FAULT
    assert "(OPERATOR)" in rig.controller.faults[0]


def test_the_bytes_of_its_latest_row_can_be_looked_at() -> None:
    rig = Rig().come_up()
    rig.tick(sense())
    assert bytes(rig.controller.row) == rig.controller.memory["row"].tobytes()


def test_a_period_in_two_parts_is_the_compiled_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A law that plans does so between them; one that does not, gives the same bits that way."""
    found = []
    for kind in (PREDICTIVE, int(LAW["tick"]["kind"][0])):
        monkeypatch.setattr(controller_module, "PREDICTIVE", kind)
        rig = Rig().come_up()
        assert (rig.controller._period.__name__ == "planning") == (kind != PREDICTIVE)
        rig.memory["outputs"][0]["bits"] = 7
        sent = [rig.tick(sense(number, (number, 5, 7)), overrun=number % 2) for number in range(1, 30)]
        rig.controller.release()
        sent.append(rig.tick())
        found.append(
            (sent, rig.controller.faults, rig.controller.memory["row"].tobytes(), rig.controller.outputs.tobytes())
        )
    assert found[0] == found[1]
    assert len(found[0][1]) == 1


def test_another_law_takes_over_between_two_ticks() -> None:
    rig = Rig().come_up()
    new = LAW.copy()
    new["tick"]["drive"]["count_slew_max"] = 77
    rig.controller.change_law(change_to(new, np.zeros(ORDER_MAX), adapts_alike=True))
    assert rig.controller.law["tick"]["drive"]["count_slew_max"][0] == 77
    assert LAW["tick"]["drive"]["count_slew_max"][0] != 77
    assert rig.tick(sense())


def test_a_start_anew_is_clean_and_one_that_fails_is_told() -> None:
    rig = Rig().come_up()
    rig.tick(sense(), frame(EMERGENCY))
    assert rig.controller.mode == Mode.FAULT
    rig.controller.gate.latched = "something"
    rig.memory["restart_due"], rig.memory["cycle"][0]["mode"] = 1, Mode.BOOT
    rig.now_us += 200
    rig.controller.begin(rig.now_us)
    assert rig.taken() == [RESET, "080 01"]
    assert (rig.controller.gate.latched, len(rig.controller.driver.emergencies)) == ("", 0)
    told = len(rig.controller.faults)
    for time in range(1, 99):
        rig.controller.begin(time * FAR_US)
        if len(rig.controller.faults) > told:
            break
    assert len(rig.controller.faults) == told + 1
    assert rig.controller.faults[-1].startswith("start-up after a clear: amplifier (node 10) sent no boot-up message")


def test_a_frame_of_the_start_up_is_answered_between_two_ticks_too() -> None:
    rig = Rig().come_up()
    rig.controller.start(200)
    rig.controller.memory["mode"] = Mode.BOOT
    rig.taken()
    rig.controller.receive(heartbeat(BOOT_UP), 300)
    assert rig.taken() == ["000 80 0a", "60a 40 00 10 00 00 00 00 00"]


def test_a_blocked_voltage_is_told_with_what_it_was_held_against() -> None:
    rig = Rig().come_up()
    rig.tick(sense())
    rig.controller.begin(400)
    rig.taken()
    rig.controller.memory["mode"] = Mode.TRACKING
    for count, t_us in ((50, 400), (20_000, 600)):
        rig.controller.memory["tick"]["count"][0, 0] = (count, 0, 0)
        rig.controller.finish(t_us, 0)
        rig.controller.begin(t_us + 200)
    assert "drive counts 20000, 0, 0 after 50, 0, 0: a step beyond" in rig.controller.faults[-1]
    drives = [words[:24] for words in rig.taken() if words.startswith("30a")]
    assert drives == ["30a 32 00 00 00 00 00 01", "30a 00 00 00 00 00 00 02"]


# -- records -----------------------------------------------------------------------------------------------------------


def test_a_part_is_the_field_itself() -> None:
    inner = np.dtype([("x", "i4"), ("three", "i4", (3,))])
    records = np.zeros(1, np.dtype([("before", "i8"), ("one", inner, (1,)), ("plain", inner), ("y", "f8")]))
    part(records, "one")["x"] = 5
    part(records, "plain", "x")[0] = 6
    part(records, "one", "three")[2] = 7
    part(records, "y")[0] = 2.5
    assert records["one"]["x"][0, 0] == 5
    assert records["plain"]["x"][0] == 6
    assert records["one"]["three"][0, 0].tolist() == [0, 0, 7]
    assert records["y"][0] == 2.5
    assert part(records, "one").shape == part(records, "plain").shape == (1,)
    assert part(part(Rig().controller.exchange, "outputs"), "bits").dtype == OUTPUTS["bits"]
