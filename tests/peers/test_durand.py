"""A plain CiA 401 module of durand's making, no alive counter and no CRC, is attached, driven, and its loss noticed."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from durand.services.nmt import StateEnum
from durand_module import PRODUCT, VENDOR, DurandModule
from node_rig import RecordingPlant

import hil.lanes.lockstep as lockstep_lane
from hil.bus.clock import Lockstep
from hil.conformance import simulated
from hil.conformance.from_eds import settings_from_eds
from hil.conformance.run import run_all
from hil.conformance.verdict import DEVIATIONS, Verdict
from hil.lanes import in_process
from hil.lanes.lane import Lane
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.loop.controller import StartUpError
from pkxyz_ctrl.safety.modes import Mode


def bus_of(name, **changes):
    """A shipped bus with a plain module of durand's vendor on it."""
    shipped = load("buses", name, BusConfig)
    driver = shipped.can.driver.model_copy(
        update={"protection": False, "vendor_id": VENDOR, "product_code": PRODUCT, **changes}
    )
    return shipped.model_copy(update={"can": shipped.can.model_copy(update={"driver": driver})})


class Bench:
    """A run in lockstep with the module in the place of our own node; ``rows`` of its record."""

    def __init__(self, monkeypatch, bus_name, *, consumer="acts", duration_s=0.4, meanwhile=None, **changes):
        self.modules, self.rows, self.frames = [], None, []

        def wired(can, clock, send, plant, switch):
            module = DurandModule(can.driver.node_id, clock, send, plant, fd=can.driver.fd, consumer=consumer)
            self.modules.append(module)
            if meanwhile is not None:
                at_us, action = meanwhile
                clock.call_at(at_us, partial(action, module))
            return module

        monkeypatch.setattr(lockstep_lane, "wired_node", wired)
        setup = load_scenario("raster").setup()
        self.setup = dataclasses.replace(setup, bus=bus_of(bus_name, **changes), duration_s=duration_s)

    def run(self):
        blocks = []
        self.result = in_process.run(self.setup, Lane.LOCKSTEP, on_block=lambda rows: blocks.append(rows.copy()))
        self.rows = np.concatenate(blocks)
        self.module = self.modules[-1]
        return self


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k"])
def test_it_is_driven_like_our_own(monkeypatch, bus_name):
    bench = Bench(monkeypatch, bus_name).run()
    assert bench.result.faults == ()
    assert bench.result.missed_ticks == 0
    tracking = bench.rows[bench.rows["mode"] == Mode.TRACKING]
    assert len(tracking) > 0.2 * len(bench.rows)
    error_m = tracking["position_m"] - tracking["reference_m"]
    assert 0.1e-9 < np.sqrt((error_m**2).mean()) < 20e-9
    assert any(bench.module.outputs)
    assert bench.module.node.object_dictionary.read(0x1016, 1) == 127 << 16 | 50


def test_it_falls_silent(monkeypatch):
    """Its sense frames and its heartbeats end: a fault, and only 0 V goes out from then on."""

    def unplugged(module):
        module._network._send = lambda frame: None

    bench = Bench(monkeypatch, "fd_5k", meanwhile=(400_000, unplugged)).run()
    assert len(bench.result.faults) == 1
    assert "SENSE_STALE" in bench.result.faults[0]
    at = int(np.argmax(bench.rows["mode"] == Mode.FAULT))
    assert bench.rows["drive_count"][at - 1].any()
    assert not bench.rows["drive_count"][at:].any()
    assert bench.module.outputs == (0, 0, 0)  # by NMT, which it still hears
    assert bench.module.node.nmt.state == StateEnum.PRE_OPERATIONAL


def test_it_is_reset_by_somebody(monkeypatch):
    """Its boot-up message tells, and its outputs are at 0 V."""

    def reset(module):
        module.node.nmt.reset()

    bench = Bench(monkeypatch, "classic_2k", meanwhile=(400_000, reset)).run()
    assert "NODE_REBOOTED" in bench.result.faults[0]
    assert bench.module.outputs == (0, 0, 0)


def test_without_us_it_goes_to_0_v_by_itself(monkeypatch):
    """What the trial of the start-up shows, with voltage: nothing of ours reaches it any more."""

    def deaf_to_us(module):
        receivers = module._network._receivers
        module.lost_us = module._clock.now_us
        for can_id in (0x000, 0x080, 0x30A, 0x77F):
            receivers.pop(can_id, None)

    bench = Bench(monkeypatch, "fd_5k", meanwhile=(400_000, deaf_to_us)).run()
    assert bench.result.faults
    assert bench.module.outputs == (0, 0, 0)
    assert bench.module.node.nmt.state == StateEnum.PRE_OPERATIONAL


@pytest.mark.parametrize(
    ("consumer", "told"),
    [
        ("stores", "did not notice that our heartbeat ended: 120 ms later its heartbeat says operational"),
        ("none", r"no 0x1016 \(consumer of our heartbeat\), and nothing else takes the combs to 0 V"),
    ],
)
def test_one_that_would_hold_its_voltage_without_us_never_has_one(monkeypatch, consumer, told):
    bench = Bench(monkeypatch, "fd_5k", consumer=consumer)
    with pytest.raises(StartUpError, match=told):
        bench.run()
    assert bench.modules[-1].outputs == (0, 0, 0)


def test_what_is_lost_with_it_is_said(monkeypatch):
    bench = Bench(monkeypatch, "fd_5k", vendor_id=None)
    rig = lockstep_lane.LockstepRig(bench.setup)
    rig.node.power_on()
    lockstep_lane.start(rig.clock, rig.port, rig.controller)
    told = rig.controller.driver.lost
    assert [line.split(":")[0] for line in told] == [
        'identity "any"',
        "protection = false",
        "no digital outputs (0x6200",
        "no signature of its safety objects (0x2020) in TPDO 3",
        "no 0x1019 (SYNC counter overflow)",
        "no 0x1029 (after a communication error",
    ]
    assert rig.controller.driver.sync(0).data == b""


DEFECTS = {
    "object dictionary: mapping in use": "0x1601:00 = 0: accepted",
    "sense PDO: transmission type": "28 sense PDOs for 30 SYNCs",  # its counter is never set back
    "EMCY: register and end": "0x1001:00 with the error: 00; no EMCY 0x0000",
    "drive PDO: negative count": "-1 at comb 1: applied",  # CiA 401 has negative counts; ours has not
}
TO_MEASURE = {
    "outputs: after reset",
    "outputs, with voltage: heartbeat lost",
    "outputs, with voltage: leaving operational",
}


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k"])
def test_the_check_is_right_on_its_defects_and_on_none_of_its_virtues(monkeypatch, tmp_path, bus_name):
    """By the EDS that the stack itself writes. 0x6411 keeps what was written last, so a voltmeter has to tell."""
    monkeypatch.setattr(
        simulated,
        "wired_node",
        lambda can, clock, send, plant, kind: DurandModule(can.driver.node_id, clock, send, plant, fd=can.driver.fd),
    )
    eds = tmp_path / "durand.eds"
    eds.write_text(own_eds())
    talker = simulated.simulated_talker(bus_of(bus_name), eds, allow_voltage=True, sample_cycles=60)
    lines = {f"{line.group}: {line.name}": line for line in run_all(talker)}
    deviating = {name: line for name, line in lines.items() if line.verdict in DEVIATIONS}
    found = {name for name, line in deviating.items() if line.verdict is not Verdict.MEASURE}
    assert found == set(DEFECTS)
    for name, told in DEFECTS.items():
        assert told in deviating[name].got
    assert set(deviating) - found == TO_MEASURE | {"outputs, with voltage: error value"}
    assert "no 0x1019" in lines["object dictionary: configuration"].got
    assert lines["outputs: heartbeat consumer"].verdict is Verdict.PASS


def own_eds():
    module = DurandModule(10, Lockstep(), lambda frame: None, RecordingPlant(), fd=False)
    module.power_on()
    return module.node.eds.content


def test_a_bus_file_takes_channels_and_pdo_numbers_from_its_eds(tmp_path):
    (tmp_path / "durand.eds").write_text(own_eds())
    found = settings_from_eds(tmp_path / "durand.eds", node_id=10)
    assert found == {
        "device_type": 0x000C0191,
        "vendor_id": VENDOR,
        "product_code": PRODUCT,
        "protection": False,
        "drive_pdo": 2,
        "sense_pdo": 2,
        "drive_channels": [1, 2, 3],
        "sense_channels": [1, 2, 3],
    }
