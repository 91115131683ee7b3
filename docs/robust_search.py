"""Searches the laws of configs/controllers/robust.toml and robust_20k.toml again and writes their numbers into these
files. Takes some minutes, so it is no part of ``make docs``.
"""

import numpy as np
import tomlkit

from pkxyz_ctrl.bus_config import BusConfig
from pkxyz_ctrl.config import CONFIG_DIR, load
from pkxyz_ctrl.controller_config import ControllerConfig
from pkxyz_ctrl.design.estimator_gain import measurement_noise
from pkxyz_ctrl.design.glover_mcfarlane import hinf
from pkxyz_ctrl.design.hold_noise import rounding_force_n
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.loop_plant import LoopPlant, loop_plant
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent
from pkxyz_ctrl.design.minimax import AxisLaw, Bounds, axis_law, minimax
from pkxyz_ctrl.design.plant_model import linearise
from pkxyz_ctrl.design.tolerances import Tolerances
from pkxyz_ctrl.stage import Stage

ENDS = ("middle", "3/3/3 um", "22/22/22 um")
"""Points that the search looks at; the tests look at all of them."""


def plants(stage: Stage, bus: BusConfig, axis: int, *, changed: bool) -> list[LoopPlant]:
    """Of one axis: as drawn first, then the changes that don't couple the axes."""
    cases = [
        c for c in load("tolerances", "wide", Tolerances).cases() if c.name.endswith(ENDS) and "comb " not in c.name
    ]
    return [loop_plant(stage, bus, c.strokes_m, c.perturbation).axis(axis) for c in (cases if changed else cases[:1])]


def search(bus_name: str) -> dict[int, AxisLaw]:
    """Laws of x (and y) and z: from known laws on, further in steps."""
    stage, bus = Stage.load("reconstructed"), load("buses", bus_name, BusConfig)
    middle = np.full(3, 12.5e-6)
    wide = design_law(stage, load("controllers", "lqg_wide", ControllerConfig), bus, autostart=True)
    lqg = lqg_equivalent(stage, wide, middle)
    model = linearise(stage, middle)
    sense, force = np.sqrt(np.diag(measurement_noise(stage, model, bus))), rounding_force_n(stage, bus, model)
    robust = bus_name == "fd_5k"
    if robust:
        starts = {0: axis_law(hinf(loop_plant(stage, bus, middle)).law, 0, extra_poles=[0.3])}
        starts[2] = axis_law(lqg, 2, extra_poles=[0.3])
        steps_hz, noise_m, changed = (150.0, 180.0, 190.0, 195.0, 201.0), 1.45e-9, 2.9
        effort, ring_s = 10.0, 5e-3  # what hinf and lqg_wide need near half the sampling rate; half the stage's own
    else:
        starts = {axis: axis_law(lqg, axis, extra_poles=[0.3, 0.5]) for axis in (0, 2)}
        steps_hz, noise_m, changed, effort, ring_s = (400.0, 500.0, 600.0, 660.0), 2.5e-9, 3.0, np.inf, np.inf
    found = {}
    for axis, law in starts.items():
        these = plants(stage, bus, axis, changed=robust)
        for bandwidth_hz in steps_hz:
            bounds = Bounds(
                bandwidth_hz, noise_m, float(sense[axis]), float(force[axis]), peak_s_changed=changed, effort=effort,
                ring_s=ring_s,
            )  # fmt: skip
            law, worst = minimax(these, law, bounds)
            print(f"{bus_name}, axis {axis}, {bandwidth_hz:g} Hz: {worst:.3f} of the bounds", flush=True)
        found[axis] = law
    return found


def write(name: str, found: dict[int, AxisLaw]) -> None:
    """Put the numbers into the controller file; everything else in it stays."""
    path = CONFIG_DIR / "controllers" / f"{name}.toml"
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    for axis, table in zip((0, 0, 2), document["linear"]["axis"], strict=True):
        for key in ("numerator", "denominator"):
            table[key] = tomlkit.array([float(v) for v in getattr(found[axis], key)]).multiline(True)
    path.write_text(tomlkit.dumps(document), encoding="utf-8")


if __name__ == "__main__":
    for name, bus in (("robust", "fd_5k"), ("robust_20k", "local_20k")):
        write(name, search(bus))
