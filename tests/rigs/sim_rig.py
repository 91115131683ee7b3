"""Plants for the laboratory: the shipped device, one effect at a time."""

from pathlib import Path

import numpy as np

from sim.config import Device, PlantConfig
from sim.plant import Plant

CONFIGS = Path(__file__).parents[2] / "configs"
DEVICE = Device.load(CONFIGS / "stages" / "reconstructed.toml")
VOLT_PER_COUNT = 200 / 32767
GRADIENT_F_PER_M = 2 * 360 * 8.8541878128e-12 * 100e-6 / 5e-6
REST_F = GRADIENT_F_PER_M * 20e-6
FARAD_PER_COUNT = 1e-16
FINE_F = 1e-18
ZERO_F = 4.0e-12

BARE = {
    "damping": {"on": True},
    "stops": {"on": False},
    "pull_in": {"on": False},
    "amplifier_bandwidth": {"on": False},
    "slew": {"on": False},
    "sense_noise": {"on": False},
}
"""Everything off that the nominal plant has on, but the damping."""


def config(**effects: dict) -> PlantConfig:
    """The bare plant with these effects on; an effect given with on=False stays off."""
    return PlantConfig.model_validate({"name": "test"} | BARE | {name: {"on": True} | e for name, e in effects.items()})


def plant(
    cfg: PlantConfig, *, seed: int = 1, period_us: int = 200, device: Device = DEVICE, fine: bool = False
) -> Plant:
    """A plant with counts of 100 aF over the whole stroke or, ``fine``, of 1 aF within 0.25 um of rest."""
    return Plant(
        cfg,
        device,
        period_us=period_us,
        seed=seed,
        drive_scale_v_per_count=VOLT_PER_COUNT,
        sense_scale_f_per_count=FINE_F if fine else FARAD_PER_COUNT,
        sense_offset_f=REST_F if fine else ZERO_F,
    )


def counts(*volts: float) -> np.ndarray:
    return np.round(np.array(volts) / VOLT_PER_COUNT).astype(np.int32)


def settle(p: Plant, duration_us: int = 400_000, step_us: int = 200) -> Plant:
    for _ in range(duration_us // step_us):
        p.advance_to(p.t_us + step_us)
    return p
