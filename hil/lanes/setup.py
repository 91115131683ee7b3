"""Everything that a run consists of, resolved: what the lanes are handed."""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from hil.faults.fault import Fault
from hil.lanes.excitation import Excitation
from pkxyz_ctrl.can.driver_config import OUR_TIMEOUT_MAX_MS
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.config.triggers import TriggersConfig
from pkxyz_ctrl.design.drive_limits import count_max, slew_counts
from pkxyz_ctrl.design.law_store import law_of
from pkxyz_ctrl.learning import Learner, LearningConfig, timetable
from pkxyz_ctrl.learning.store import Stored
from pkxyz_ctrl.loop import outputs
from pkxyz_ctrl.safety.gate import GateConfig
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Hold, Trajectory
from pkxyz_ctrl.trajectory.check import DriveLimits, within_limits
from sim.config import Device, PlantConfig
from sim.plant import Plant


@dataclass(frozen=True)
class Setup:
    """One run, ready to be run by either lane."""

    stage: StageConfig
    device: Device
    """What the plant knows of the stage, read from the same file on its own."""
    plant: PlantConfig
    controller: ControllerConfig
    bus: BusConfig
    trajectory: Trajectory
    duration_s: float
    seed: int
    excitation: Excitation | None = None
    """added to what the controller measures while it tracks"""
    faults: tuple[Fault, ...] = ()
    """what goes wrong; lockstep lane only"""
    clear_s: float | None = None
    """how long after a fault decision somebody clears the fault; None: nobody does"""
    learning: LearningConfig | None = None
    stored: Stored | None = None
    """the correction of ``learning.file``"""
    autostart: bool = True
    """home, enable and track without being asked"""
    triggers: TriggersConfig | None = None
    """what goes to the node's digital outputs, besides the bits of ``trajectory``"""

    @property
    def ticks(self) -> int:
        """Ticks in ``duration_s``."""
        return round(self.duration_s * 1e6 / self.bus.period_us)

    @cached_property
    def law(self) -> NDArray[np.void]:
        """The numbers that the cycle runs on, designed and cross-checked."""
        return law_of(self.stage, self.controller, self.bus, autostart=self.autostart)

    @property
    def gate(self) -> GateConfig:
        """What the transmit gate holds frames to: the same limits, handed over as numbers of counts."""
        assert self.bus.can is not None
        driver, period_us = self.bus.can.driver, self.bus.period_us
        latest_us = self.bus.can.sense_deadline_us + self.bus.can.compute_us
        return GateConfig(
            count_max=count_max(Stage(self.stage), self.controller, self.bus),
            count_slew_max=slew_counts(self.controller, self.bus),
            period_us=period_us,
            spacing_min_us=min(
                period_us // 2, period_us - latest_us
            ),  # behind a tick that waited for its frame in vain
            node_id=driver.node_id,
            controller_node_id=driver.controller_node_id,
            protection=driver.protection,
            fd=driver.fd,
            heartbeat_timeout_max_ms=OUR_TIMEOUT_MAX_MS,
            drive_pdo=driver.drive_pdo,
            drive_channels=driver.drive_channels,
            digital_outputs=driver.output_id >= 0,
        )

    def new_outputs(self) -> NDArray[np.void]:
        """(1,) of ``outputs.OUTPUTS`` as the run wants them, nothing seen."""
        fresh = np.zeros(1, outputs.OUTPUTS)
        outputs.set_up(fresh, self.triggers, self.bus.period_s)
        return fresh

    def new_learner(self) -> Learner | None:
        """One that has seen nothing yet; None for a run that doesn't learn."""
        if self.learning is None:
            return None
        period_us, drive = self.bus.period_us, DriveLimits.of(self.controller, self.bus)
        return Learner(
            self.learning,
            timetable(self.trajectory, period_us),
            self.trajectory,
            period_us,
            partial(within_limits, Stage(self.stage), drive=drive),
            float(self.law["tick"]["estimator"]["sense_delay_s"][0]),
            self.stored,
        )

    def new_plant(self) -> Plant:
        """A plant at rest, at its time 0."""
        return self._plant_at_rest.copy()

    @cached_property
    def _plant_at_rest(self) -> Plant:
        """Nobody moves it: built once, as the law is designed once."""
        return Plant(
            self.plant,
            self.device,
            period_us=self.bus.period_us,
            seed=self.seed,
            drive_scale_v_per_count=self.bus.analog.drive_volt_per_count,
            sense_scale_f_per_count=self.bus.analog.sense_farad_per_count,
            sense_offset_f=self.bus.analog.sense_offset_f,
        )


def bare_setup(
    stage: str, plant: str, controller: ControllerConfig, bus: BusConfig, seed: int, *, autostart: bool = True
) -> Setup:
    """A run at rest, of no length, for whoever puts a trajectory of their own into it; stage and plant by name or
    file. Raises ``ConfigError``.
    """
    return Setup(
        stage=load("stages", stage, StageConfig),
        device=load("stages", stage, Device),
        plant=load("plants", plant, PlantConfig),
        controller=controller,
        bus=bus,
        trajectory=Trajectory([Hold(kind="hold", duration_s=bus.period_s)]),
        duration_s=bus.period_s,
        seed=seed,
        autostart=autostart,
    )
