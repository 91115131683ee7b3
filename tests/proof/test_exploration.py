"""The composition explored, as far as a test has time: all with one fault, and every planted defect.

``make prove`` explores the larger configurations of ``world.CONFIGURATIONS``; docs/understand/how-it-is-tested.md says
what that shows.
"""

import random
import re
from collections.abc import Callable

import numpy as np
import pytest
from configurations import CONFIGURATIONS, LEVELS, SIGNATURE, Configuration
from defective.kernels import (
    drives_always,
    drives_behind_outputs,
    drives_nothing,
    looks_at_bits_alone,
    planted,
    without_gate,
    without_output_rules,
    without_release,
)
from explore import Explored, explore
from numpy.typing import NDArray
from product import SHIFT, TICK, row_of
from sides import ControllerSide, NodeSide
from story import as_text, from_text, tell
from world import Composition, World

from hil.node import signature as signature_module
from hil.node.amplifier import AmplifierNode
from hil.node.digital import DigitalOutputs
from hil.node.drive import DriveReceiver
from hil.node.heartbeat import HeartbeatConsumer
from hil.node.signature import SignatureTransmitter
from pkxyz_ctrl.can import driver as driver_module
from pkxyz_ctrl.can import start_plan
from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import SAFETY_OBJECTS, DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.startup import Setting
from pkxyz_ctrl.loop import exchange
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.safety.gate import TransmitGate
from pkxyz_ctrl.safety.modes import Event, Mode

ONE = CONFIGURATIONS["one"]
FRAMES = Configuration("one frame", 1, kinds=ONE.kinds - {"cut"})


def test_without_a_fault_every_state_is_sound() -> None:
    found = explore(CONFIGURATIONS["well"])
    assert not found.violation, tell(CONFIGURATIONS["well"], found.story)
    assert found.is_complete
    assert found.states > 100


def test_with_one_fault_every_state_is_sound() -> None:
    """To a fixed point: no invariant fails, a way back from everywhere, no start-up for ever. And what was explored is
    worth it: every mode, every level of the combs, every state of the driver but the one before it is started.
    """
    found = explore(FRAMES)
    assert not found.violation, tell(FRAMES, found.story)
    assert found.is_complete
    assert found.states > 5000
    assert 1 <= found.longest <= FRAMES.settle_ticks
    modes, drivers, combs = zip(*found.met, strict=True)
    assert set(modes) == set(Mode) - {Mode.TRACKING}
    assert set(drivers) == set(DriverState) - {DriverState.OFF}
    assert set(combs) == set(LEVELS)


@pytest.mark.parametrize("name", ["outputs, well", "signature, well"])
def test_with_what_is_not_in_every_tick_every_state_is_sound(name: str) -> None:
    found = explore(CONFIGURATIONS[name])
    assert not found.violation, tell(CONFIGURATIONS[name], found.story)
    assert found.is_complete
    assert {Mode.ENABLED, Mode.LANDING, Mode.FAULT} <= {mode for mode, _, _ in found.met}
    assert found.has_put_out == CONFIGURATIONS[name].has_outputs
    assert found.has_signed == CONFIGURATIONS[name].has_signature


@pytest.mark.parametrize("configuration", [FRAMES, CONFIGURATIONS["outputs"], CONFIGURATIONS["signature"]])
def test_a_state_with_one_key_has_one_future(configuration: Configuration) -> None:
    """The abstraction, tried: both sides live, never put back, answer all along each way as the rows say, although
    their counters, times and histories are others than those of the states by which the rows were made.
    """
    generator = random.Random(2)
    composition = Composition(configuration)
    rows_by = composition.controller, composition.node
    compared = 0
    for walk in range(40):
        world = World(composition)
        live = ControllerSide(configuration, composition.known), NodeSide(configuration, composition.known)
        for side, of in zip(live, rows_by, strict=True):
            side.kept = of.kept
        composition.rows.looks[:] = 1, 0
        for _ in range(60 + 5 * walk):
            world.settle()
            choices = world.choices()
            if not choices:
                break
            weights = [30, *[1 + 8 * (choice >> 8 == TICK) for choice in choices[1:]]]
            world.take(generator.choices(choices, weights)[0])
            rows, asked = composition.rows, composition.rows.looks[1]
            assert asked <= len(rows.asked)
            for by, state, question in rows.asked[:asked].tolist():
                if by < len(live):
                    compared += live[by].bases != rows_by[by].kept.taken[state][1]
                    answer, row = live[by].go_on(question), rows.answers[row_of(rows, by, state, question)]
                    assert (answer.to, answer.told) == (row["to"], row["told"])
                    assert (answer.drive, answer.sync, answer.sense) == (row["drive"], row["sync"], row["sense"])
                    assert answer.frames == tuple(row["frames"][: row["sent"]])
            rows.looks[1] = 0
    assert compared > 1000


def test_a_state_is_taken_and_put_back_whole() -> None:
    composition = Composition(FRAMES)
    world = World(composition)
    for _ in range(40):
        world.settle()
        world.take(world.choices()[-1])
    for side, count in ((composition.controller, 50), (composition.node, 30)):
        assert side.kept.count > count
        assert [side.answer(state, SHIFT).to for state in range(side.kept.count)] == list(range(side.kept.count))


# -- planted defects -----------------------------------------------------------------------------------------

Plant = Callable[[pytest.MonkeyPatch], None]


def _no_step_limit(patch: pytest.MonkeyPatch) -> None:
    """The node as it was: whatever passes is applied. The gate's rule alone can't hold the slew limit."""
    shipped = AmplifierNode._apply

    def apply(node: AmplifierNode, counts: tuple[int, int, int], t_us: int) -> tuple[int, int, int] | None:
        node._step_max = 32767
        return shipped(node, counts, t_us)

    patch.setattr(AmplifierNode, "_apply", apply)


def _old_start_up(patch: pytest.MonkeyPatch) -> None:
    """A controller that has to see CONFIGURING at the beginning of a tick, or waits for ever."""
    shipped = Controller.begin

    def begin(controller: Controller, t_us: int) -> None:
        shipped(controller, t_us)
        if controller.mode == Mode.BOOT and controller.driver.state is DriverState.OPERATIONAL:
            controller.exchange["event"] = Event.NODE_READY

    patch.setattr(Controller, "begin", begin)


def _no_crc(patch: pytest.MonkeyPatch) -> None:
    """A node that looks at no CRC: one flipped bit makes a step of a count too many."""
    shipped = DriveReceiver._receive_protected

    def receive(drive: DriveReceiver, data: bytes, t_us: int) -> None:
        if len(data) == 8:
            a, b, c = (int.from_bytes(data[i : i + 2], "little") for i in (0, 2, 4))
            right = drive._w0[a] ^ drive._w1[b] ^ drive._w2[c] ^ drive._w3[data[6]]
            data = data[:7] + bytes((right,))
        shipped(drive, data, t_us)

    patch.setattr(DriveReceiver, "_receive_protected", receive)
    _no_step_limit(patch)


def _believes_what_is_written(patch: pytest.MonkeyPatch) -> None:
    """A start-up that tries nothing: whoever stores 0x1016 is taken to act on it."""
    shipped = driver_module.start_record

    def proven(config: DriverConfig, rows: tuple[Setting, ...]) -> NDArray[np.void]:
        record = shipped(config, rows)
        node = {setting.key: setting.value or 0 for setting in rows}
        record["proven"] = [node[0x1018, 1], node[0x1018, 2], 0x10000, 1]  # revision and serial number of the EDS
        record["shown"] = start_plan.SHOWN_DRIVE_TIMEOUT
        return record

    patch.setattr(driver_module, "start_record", proven)


def _started_untried(patch: pytest.MonkeyPatch) -> None:
    _deaf_to_silence(patch)
    _believes_what_is_written(patch)


def _deaf_to_silence(patch: pytest.MonkeyPatch) -> None:
    """A node without any time-out: what it holds, it holds for as long as nothing comes."""
    patch.setattr(AmplifierNode, "_count_silence", lambda node, t_us: None)
    patch.setattr(AmplifierNode, "_drive_overdue", lambda node, now_us: None)
    patch.setattr(HeartbeatConsumer, "_time_out", lambda consumer, now_us: None)


def _unhomed(patch: pytest.MonkeyPatch) -> None:
    """A gate that knows no modes, behind a controller that sends a voltage in all of them."""
    patch.setattr(TransmitGate, "check", lambda gate, frame, mode, t_us: None)
    without_gate(patch, drive=drives_always)


def _no_way_back(patch: pytest.MonkeyPatch) -> None:
    """A controller that hears nobody who clears."""
    patch.setattr(Controller, "clear", lambda controller: None)


def _no_gate(patch: pytest.MonkeyPatch) -> None:
    """No gate at all: the law's 21 counts reach a node whose own limit is far away."""
    patch.setattr(TransmitGate, "check", lambda gate, frame, mode, t_us: None)
    without_gate(patch)
    _no_step_limit(patch)


def _puts_out_at_once(patch: pytest.MonkeyPatch) -> None:
    """A node that waits for no SYNC with its digital outputs."""
    shipped = DigitalOutputs.receive

    def receive(outputs: DigitalOutputs, data: bytes, t_us: int) -> None:
        shipped(outputs, data, t_us)
        outputs.on_sync(t_us)

    patch.setattr(DigitalOutputs, "receive", receive)


def _keeps_its_outputs(patch: pytest.MonkeyPatch) -> None:
    """A node that is stopped and leaves its digital outputs where they are."""
    patch.setattr(DigitalOutputs, "to_error_value", lambda outputs, t_us: None)


def _outputs_first(patch: pytest.MonkeyPatch) -> None:
    """A controller whose voltages wait behind its digital outputs."""
    patch.setattr(exchange, "finish", planted(exchange.finish, drive=drives_behind_outputs))


def _no_voltages(patch: pytest.MonkeyPatch) -> None:
    """A controller that leaves out its drive frames."""
    patch.setattr(exchange, "finish", planted(exchange.finish, drive=drives_nothing))


def _outputs_in_fault(patch: pytest.MonkeyPatch) -> None:
    """A controller that knows no FAULT when it sends digital outputs, and a gate that does not either."""
    without_output_rules(patch, looks_at_bits_alone, _FAULT=-1)


def _signs_wrong(patch: pytest.MonkeyPatch) -> None:
    """A node that signs something else at work."""
    signed = signature_module.signature
    patch.setattr(signature_module, "signature", lambda od: signed(od) ^ 1)


def _heedless_of_signatures(patch: pytest.MonkeyPatch) -> None:
    """A controller in which nobody is told of them."""
    _signs_wrong(patch)
    shipped = Controller.compute

    def compute(controller: Controller, reference: NDArray[np.void], overrun: int) -> None:
        events = controller.driver.memory["node_events"]
        told = events.copy()
        events &= ~SAFETY_OBJECTS
        shipped(controller, reference, overrun)
        events |= told

    patch.setattr(Controller, "compute", compute)


def _deaf_to_wrong_signatures(patch: pytest.MonkeyPatch) -> None:
    """A controller that hears only the signature that it expects."""
    _signs_wrong(patch)
    shipped = Controller.receive

    def receive(controller: Controller, frame: Frame, t_us: int) -> bool:
        expected = int(controller.driver.memory["signature"][0])
        if frame.can_id == SIGNATURE and int.from_bytes(frame.data, "little") != expected:
            return False
        return shipped(controller, frame, t_us)

    patch.setattr(Controller, "receive", receive)


def _patient_without_signature(patch: pytest.MonkeyPatch) -> None:
    """A node that says it signs and does not, and a controller that waits for a hundred SYNCs."""
    shipped = AmplifierDriver._configure

    def configure(driver: AmplifierDriver) -> None:
        shipped(driver)
        driver.record["signature_syncs"] = 100

    patch.setattr(AmplifierDriver, "_configure", configure)
    patch.setattr(SignatureTransmitter, "ride", lambda transmitter, has_heartbeat: None)


def _keeps_its_voltage(patch: pytest.MonkeyPatch) -> None:
    """A node that is stopped and leaves its combs where they are."""
    patch.setattr(AmplifierNode, "_outputs_to_error_value", lambda node: None)


PLANTED: dict[str, tuple[Plant, str]] = {
    "node without a step limit": (_no_step_limit, "a step from"),
    "start-up that has to be seen": (_old_start_up, "a start-up can go on for ever"),
    "node without a CRC": (_no_crc, "a step from"),
    "node without time-outs, not tried": (_started_untried, "ticks after the decision|gate takes combs"),
    "voltage in every mode": (_unhomed, "a voltage is sent"),
    "nobody can clear": (_no_way_back, "no way leads back"),
    "no gate": (_no_gate, "a step from|beyond 0"),
    "node that keeps its voltage": (_keeps_its_voltage, "ticks after the decision|gate takes combs"),
    "node that waits for no SYNC": (_puts_out_at_once, "without a SYNC"),
    "node that keeps its outputs": (_keeps_its_outputs, "digital outputs stay"),
    "outputs ahead of voltages": (_outputs_first, "right behind the voltages"),
    "no voltages": (_no_voltages, "not what it sends first"),
    "outputs in FAULT": (_outputs_in_fault, "digital outputs are sent in FAULT"),
    "any bits": (without_output_rules, "which nobody may set"),
    "node left operational in FAULT": (without_release, "digital outputs are still"),
    "signature without effect": (_heedless_of_signatures, "the signature is wrong or missing, and"),
    "wrong signature": (_deaf_to_wrong_signatures, "a wrong signature is taken"),
    "no signature": (_patient_without_signature, "ticks without a signature"),
}


EXPLORED_WITH = {
    "node that waits for no SYNC": ("outputs, well",),
    "node that keeps its outputs": ("outputs, well",),
    "outputs ahead of voltages": ("outputs, well",),
    "no voltages": ("well",),
    "outputs in FAULT": ("outputs, well",),
    "any bits": ("outputs, well",),
    "node left operational in FAULT": ("outputs, well",),
    "signature without effect": ("signature, well",),
    "wrong signature": ("signature, well",),
    "no signature": ("signature, well",),
}
"""Where it shows; elsewhere without a fault, or with one."""


def test_a_node_without_time_outs_never_has_a_voltage(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its start-up ends where our heartbeat is left out on purpose, whatever else goes wrong."""
    _deaf_to_silence(monkeypatch)
    found = explore(ONE)
    assert not found.violation
    assert found.is_complete
    modes, _, combs = zip(*found.met, strict=True)
    assert set(combs) == {(0, 0, 0)}
    assert set(modes) <= {Mode.BOOT, Mode.PRE_OPERATIONAL}


@pytest.mark.parametrize("name", PLANTED)
def test_each_planted_defect_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plant, expected = PLANTED[name]
    configurations = [CONFIGURATIONS[named] for named in EXPLORED_WITH.get(name, ("well", "one"))]
    plant(monkeypatch)
    found: Explored | None = None
    for configuration in configurations:
        found = explore(configuration)
        if found.violation:
            break
    assert found is not None
    assert re.search(expected, found.violation), found.violation or "nothing was found"
    told = tell(configuration, found.story)
    assert f"VIOLATION: {found.violation}" in told or "way" in found.violation or "for ever" in found.violation
    again, way = from_text(as_text(configuration, found.story))
    assert again == configuration.name
    assert tell(CONFIGURATIONS[again], way) == told
