"""What a plant file may say, and what a stage file says of the device."""

from sim.config.device import Device
from sim.config.plant_file import PlantConfig

__all__ = ["Device", "PlantConfig"]
