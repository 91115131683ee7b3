"""The software plant as an object: integer time, counts in, counts out, and a view of the truth."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from sim import kernels
from sim.config import Device, PlantConfig
from sim.motion import layout
from sim.parameters import build_parameters, state_at_rest
from sim.structure.pose import combs_seen, stand

KINDS = {layout.STOP: "stop", layout.PULLED_IN: "pulled_in", layout.BROKEN: "broken"}


class Event(NamedTuple):
    """Something that happened to the stage in the step that ended at t_us. ``kind`` is stop, pulled_in or broken;
    ``chain`` 1, 2, 3, or 0 for the whole stage."""

    t_us: int
    kind: str
    chain: int


def _copied(record: np.ndarray) -> np.ndarray:
    """Of a one-element record, which numpy would copy field by field."""
    return np.frombuffer(bytearray(record.tobytes()), record.dtype)


class Plant:
    """Stage, amplifier and sense electronics. Starts in static equilibrium with zero counts on the converters, at
    t_us = 0.

    Args:
        config: effects with their sizes.
        device: what the stage file says of the device.
        period_us: sampling period, which sets the noise of a sample (density * sqrt(f / 2)).
        seed: of every random stream, together with the source and its ``seed_offset``.
        drive_scale_v_per_count: volts at the converter per drive count.
        sense_scale_f_per_count, sense_offset_f: a sense count of n shows sense_offset_f + n * sense_scale_f_per_count.

    ``params`` and ``state`` are the one-element records which ``sim.kernels`` works on; calling the kernels on them
    and calling the methods here is one and the same.
    """

    def __init__(
        self,
        config: PlantConfig,
        device: Device,
        *,
        period_us: int,
        seed: int,
        drive_scale_v_per_count: float,
        sense_scale_f_per_count: float,
        sense_offset_f: float,
    ) -> None:
        if period_us <= 0:
            raise ValueError(f"period_us must be positive, got {period_us}")
        if drive_scale_v_per_count <= 0 or sense_scale_f_per_count <= 0:
            raise ValueError("drive_scale_v_per_count and sense_scale_f_per_count must be positive")
        self.params = build_parameters(
            config,
            device,
            period_us=period_us,
            drive_v_per_count=drive_scale_v_per_count,
            sense_f_per_count=sense_scale_f_per_count,
            sense_zero_f=sense_offset_f,
        )
        self._begin(self.params, state_at_rest(self.params, config, seed))

    def _begin(self, params: np.ndarray, state: np.ndarray) -> None:
        self.params, self.state = params, state
        self._time_us = self.state["t_us"]  # a view
        self._counts_in = np.zeros(3, np.int32)
        self._counts_out = np.zeros(3, np.int32)

    def copy(self) -> Self:
        """Another plant of the same device, as this one is now: from here on each goes its own way."""
        other = object.__new__(type(self))
        other._begin(_copied(self.params), _copied(self.state))
        return other

    @property
    def t_us(self) -> int:
        """Time that the plant has been integrated to."""
        return int(self._time_us.item())

    def advance_to(self, t_us: int) -> None:
        """Integrate up to t_us with what the converters hold. Raises ValueError for a time that has passed."""
        dt_us = t_us - self._time_us.item()
        if dt_us < 0:
            raise ValueError(f"the plant is at {self.t_us} us already and cannot go back to {t_us} us")
        kernels.advance(self.params, self.state, dt_us)

    def drive(self, counts: Sequence[int] | np.ndarray) -> None:
        """Put three INTEGER16 drive counts on the converters now."""
        row = self._counts_in
        row[0], row[1], row[2] = counts
        kernels.drive(self.params, self.state, row)

    def sample(self) -> tuple[int, int, int]:
        """Sample the three sense channels now; their noise is new. INTEGER16 counts, saturated."""
        kernels.sample(self.params, self.state, self._counts_out)
        a, b, c = self._counts_out.tolist()
        return a, b, c

    @property
    def position_m(self) -> np.ndarray:
        """True position of the table's point of interest (3,), relative to the rest pose, with the modes' part."""
        out = np.empty(3)
        stand(self.params[0], self.state[0], out)
        return out

    @property
    def velocity_m_per_s(self) -> np.ndarray:
        """True velocity of the table's point of interest (3,), with the modes' part."""
        p, s = self.params[0], self.state[0]
        table = np.asarray(s["motion"][3:] + p["parasitic_table"] * s["parasitic"][1])
        return table + p["tilt_shift"] @ table if p["tilt_on"] else table

    @property
    def stroke_m(self) -> np.ndarray:
        """True strokes of the sliders (3,) from rest, as the sense combs move: with the modes' part."""
        out = np.empty(3)
        combs_seen(self.params[0], self.state[0], out, np.empty(3))
        return out

    @property
    def voltage_v(self) -> np.ndarray:
        """Voltages at the drive combs (3,)."""
        return np.array(self.state["voltage_v"][0])

    @property
    def external_force_n(self) -> np.ndarray:
        """Force from outside on the table (3,), N; stays until it is set anew."""
        return np.array(self.state["external_n"][0])

    @external_force_n.setter
    def external_force_n(self, force_n: Sequence[float] | np.ndarray) -> None:
        force = np.asarray(force_n, dtype=float)
        if force.shape != (3,) or not np.isfinite(force).all():
            raise ValueError(f"an external force is three finite numbers in N, got {force_n!r}")
        self.state["external_n"][0] = force

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened to the stage, oldest first; the first ``layout.EVENTS`` of them."""
        s = self.state[0]
        n = min(int(s["event_count"]), layout.EVENTS)
        return tuple(
            Event(int(t), KINDS[int(kind)], int(chain) + 1)
            for t, kind, chain in zip(s["event_t_us"][:n], s["event_kind"][:n], s["event_chain"][:n], strict=True)
        )
