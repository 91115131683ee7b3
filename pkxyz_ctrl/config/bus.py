"""How the controller talks to the amplifier: rate, bus, scales."""

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.config.files import FrozenModel, Name

Positive = Annotated[float, Field(gt=0)]


class CanConfig(FrozenModel):
    """The CAN segment and the node on it."""

    interface: str = "pkxyz-sim"
    """python-can interface: "pkxyz-sim" for the simulated bus, else socketcan, slcan, gs_usb, virtual ..."""
    channel: str = "pkxyz"
    options: dict[str, str | int | float | bool] | None = None
    """What else python-can wants to know about this interface, by its names: ``receive_own_messages = false`` ..."""
    nominal_bitrate_bit_per_s: Annotated[int, Field(gt=0, le=1_000_000)]
    data_bitrate_bit_per_s: Annotated[int, Field(gt=0, le=8_000_000)] | None = None
    """Bit rate of the data phase of FD frames; absent on a classic bus."""
    turnaround_us: Annotated[int, Field(ge=0, le=1000)]
    """From the end of the SYNC frame until the node's sense frame is ready to be sent."""
    compute_us: Annotated[int, Field(ge=0, le=1000)]
    """From the end of the sense frame until the controller's drive frame is ready to be sent; lockstep charges it."""
    sense_deadline_us: Annotated[int, Field(gt=0)]
    """After the start of a tick: when the controller computes without this tick's sense frame, so that its drive
    frame is in time.
    """
    heartbeat_deadline_us: Annotated[int, Field(gt=0)]
    """After the start of a tick: until when a drive frame and our heartbeat behind it end before the next SYNC."""
    standstill_max_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """For so long at once the loop's time stands still where the loop or the amplifier's answer is late, so that
    neither has missed anything. Only for an amplifier that is simulated beside the loop: real time waits for nobody.
    """
    driver: DriverConfig

    @property
    def short_frame_us(self) -> int:
        """What a frame of one byte takes at most, with all stuff bits that there can be (ISO 11898-1:2015, 10.4)."""
        if self.data_bitrate_bit_per_s is None:
            bits, fast_s = 65, 0.0
        else:
            bits, fast_s = 33, 44 / self.data_bitrate_bit_per_s
        return math.ceil((bits / self.nominal_bitrate_bit_per_s + fast_s) * 1e6)

    @model_validator(mode="after")
    def _only_processes_wait(self) -> Self:
        if self.standstill_max_us and self.interface != "pkxyz-unix":
            raise ValueError(
                f"standstill_max_us is for interface pkxyz-unix, where the amplifier may be simulated; what is behind "
                f"{self.interface} does not wait: leave it out"
            )
        return self

    @model_validator(mode="after")
    def _rates_match(self) -> Self:
        if self.driver.fd != (self.data_bitrate_bit_per_s is not None):
            raise ValueError(
                "driver.fd and data_bitrate_bit_per_s belong together: give both for CAN FD, neither for classic CAN"
            )
        return self


class AnalogConfig(FrozenModel):
    """Counts of the process image and what they mean."""

    drive_volt_per_count: Positive
    """Output count to comb voltage; count 0 is 0 V, so that a cleared buffer discharges the combs."""
    sense_farad_per_count: Positive
    sense_offset_f: Positive
    """Capacitance of input count 0."""


class BusConfig(FrozenModel):
    """One way to reach a stage: the period of the loop and what lies between a sample and its consequence."""

    name: Name
    period_us: Annotated[int, Field(ge=20, le=100_000)]
    delay_periods: Annotated[int, Field(ge=1, le=2)] = 1
    """Periods from a sample to the start of the action that it causes; 2 for adapters that cannot answer within one."""
    analog: AnalogConfig
    can: CanConfig | None = None
    """Absent: no bus at all, fast lane only."""

    @model_validator(mode="after")
    def _deadlines_within_the_period(self) -> Self:
        can = self.can
        if can is not None and max(can.sense_deadline_us + can.compute_us, can.heartbeat_deadline_us) >= self.period_us:
            raise ValueError(
                "can.sense_deadline_us + compute_us and can.heartbeat_deadline_us must lie within period_us"
            )
        return self

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""
        return self.period_us * 1e-6
