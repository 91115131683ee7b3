"""The node on the real wire, with the real driver as master and the real plant behind it."""

from pathlib import Path

import pytest
from node_rig import EDS, NODE_ID, SENSE, RecordingPlant

from hil.bus.clock import Lockstep
from hil.bus.wire import Wire
from hil.node.amplifier import AmplifierNode, NmtState
from hil.node.sense import Plant
from hil.plant.on_bus import PlantOnBus
from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from sim.config import PlantConfig
from sim.config.device import Device
from sim.plant import Plant as SimPlant

CONFIGS = Path(__file__).parents[2] / "configs"
VOLT_PER_COUNT = 200 / 32767
TURNAROUND_US = 2


class Bench:
    """Driver, wire and node; ``seen`` holds every frame as (t_us of its end, frame)."""

    def __init__(self, plant: Plant, *, fd: bool = True, protection: bool = True) -> None:
        self.clock = Lockstep()
        self.plant = plant
        self.wire = Wire(self.clock, 1_000_000, 5_000_000 if fd else None)
        self.period_us = 200 if fd else 500
        self.seen: list[tuple[int, Frame]] = []
        self.wire.attach("tap", lambda frame, t_us: self.seen.append((t_us, frame)), listen_only=True)
        self.driver = AmplifierDriver(DriverConfig(node_id=NODE_ID, fd=fd, protection=protection))
        self.master = self.wire.attach("driver", self._to_driver)
        self.device = self.wire.attach("node", lambda frame, t_us: self.node.on_frame(frame, t_us))
        self.node = AmplifierNode(
            NODE_ID,
            self.clock,
            self.device.send,
            plant,
            EDS,
            turnaround_us=TURNAROUND_US,
            fd=fd,
            protection=protection,
        )
        self.node.power_on()

    def _to_driver(self, frame: Frame, t_us: int) -> None:
        for reply in self.driver.receive(frame, t_us):
            self.master.send(reply)

    def start(self) -> None:
        for frame in self.driver.start(self.clock.now_us):
            self.master.send(frame)
        for _ in range(400):
            self.clock.run_until(self.clock.now_us + 1000)
            for frame in self.driver.poll(self.clock.now_us):
                self.master.send(frame)
            if self.driver.state in (DriverState.OPERATIONAL, DriverState.FAILED):
                break
        assert self.driver.state is DriverState.OPERATIONAL, self.driver.failure
        self.cycle((0, 0, 0))  # after a lost heartbeat, that of the trial, nothing else is taken first
        self.cycle((0, 0, 0))

    def cycle(self, counts: tuple[int, int, int]) -> tuple[int, int, int, int]:
        """One period; what the driver got from the sense combs."""
        t_us = self.clock.now_us
        self.master.send(self.driver.sync(t_us))
        self.clock.run_until(t_us + (130 if self.period_us == 200 else 350))
        sense = self.driver.sense.take()
        self.master.send(self.driver.drive(counts, self.clock.now_us))
        heartbeat = self.driver.heartbeat_due(self.clock.now_us)
        if heartbeat is not None:
            self.master.send(heartbeat)
            self.driver.heartbeat_sent(self.clock.now_us)
        self.clock.run_until(t_us + self.period_us)
        return sense


@pytest.mark.parametrize("protection", [True, False])
@pytest.mark.parametrize("fd", [True, False])
def test_the_driver_starts_the_node_and_both_agree_on_every_cycle(fd: bool, protection: bool) -> None:
    plant = RecordingPlant()
    bench = Bench(plant, fd=fd, protection=protection)
    bench.clock.run_until(5000)
    bench.start()
    plant.driven.clear()
    sent = [(k % 32768, 2 * k % 32768, 32767 - k) for k in range(600)]
    statuses = {bench.cycle(counts)[3] for counts in sent}
    bench.cycle((0, 0, 0))
    assert statuses == {0}
    assert [counts for _, counts in plant.driven] == [(0, 0, 0), *sent]
    assert bench.driver.node_events == 0
    assert bench.node.emergency.active == ()
    assert bench.node.state is NmtState.OPERATIONAL


def test_sense_pdo_and_heartbeat_fall_where_they_should() -> None:
    bench = Bench(RecordingPlant())
    bench.clock.run_until(5000)
    bench.start()
    bench.seen.clear()
    for _ in range(1000):
        bench.cycle((100, 100, 100))
    syncs = [t_us for t_us, frame in bench.seen if frame.can_id == 0x080]
    senses = [t_us for t_us, frame in bench.seen if frame.can_id == SENSE]
    beats = [(t_us, i) for i, (t_us, frame) in enumerate(bench.seen) if frame.can_id == 0x700 + NODE_ID]
    assert len(syncs) == len(senses) == 1000
    delays = [sense_us - sync_us for sync_us, sense_us in zip(syncs, senses, strict=True)]
    assert min(delays) > TURNAROUND_US + 40
    assert max(delays) < TURNAROUND_US + 62
    assert 10 <= len(beats) <= 11
    assert all(bench.seen[i - 1][1].can_id == SENSE for _, i in beats)


def test_silence_of_the_controller_ends_at_zero_volts() -> None:
    """The SYNC goes on without drive PDOs: 0x2010. All falls silent: the heartbeat consumer."""
    plant = RecordingPlant()
    bench = Bench(plant)
    bench.clock.run_until(5000)
    bench.start()
    for _ in range(150):
        bench.cycle((100, 200, 300))
    last_heartbeat_us = next(t_us for t_us, frame in reversed(bench.seen) if frame.can_id == 0x77F)
    bench.clock.run_until(bench.clock.now_us + 100_000)
    timeout_us = 1000 * bench.driver.config.controller_heartbeat_timeout_ms
    assert plant.driven[-1] == (last_heartbeat_us + timeout_us, (0, 0, 0))
    assert bench.driver.emergencies[-1].code == 0x8130
    assert bench.node.state is NmtState.PRE_OPERATIONAL
    bench.start()
    for _ in range(10):
        bench.cycle((5, 6, 7))
    for _ in range(10):
        t_us = bench.clock.now_us
        bench.master.send(bench.driver.sync(t_us))
        bench.clock.run_until(t_us + 200)
    assert plant.driven[-2][1] == (5, 6, 7)
    assert plant.driven[-1][1] == (0, 0, 0)
    assert plant.driven[-1][0] - plant.driven[-2][0] == 200 * bench.driver.config.drive_timeout_syncs


def test_with_the_real_plant_the_stage_moves_and_falls_back() -> None:
    plant = SimPlant(
        PlantConfig.load(CONFIGS / "plants" / "nominal.toml"),
        Device.load(CONFIGS / "stages" / "reconstructed.toml"),
        period_us=200,
        seed=1,
        drive_scale_v_per_count=VOLT_PER_COUNT,
        sense_scale_f_per_count=68e-18,
        sense_offset_f=4.14e-12,
    )
    bench = Bench(PlantOnBus(plant))
    bench.clock.run_until(5000)
    bench.start()
    at_rest = bench.cycle((10_000, 10_000, 10_000))
    for _ in range(100):
        held = bench.cycle((10_000, 10_000, 10_000))
    assert plant.voltage_v == pytest.approx([10_000 * VOLT_PER_COUNT] * 3, abs=1e-2)
    assert all(now - before > 1000 for now, before in zip(held[:3], at_rest[:3], strict=True))
    for frame in bench.driver.stop(bench.clock.now_us):
        bench.master.send(frame)
    bench.clock.run_until(bench.clock.now_us + 2000)
    bench.plant.exchange(bench.clock.now_us, None, sample=False)
    assert plant.voltage_v == pytest.approx([0.0] * 3, abs=1e-2)
