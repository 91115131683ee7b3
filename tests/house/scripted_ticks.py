"""Two short stories of the controller, told with the compiler and without: ``python scripted_ticks.py OUT.npy``."""

import sys

import numpy as np
from loop_rig import MIDDLE, Cycle, Rows, bus, controller_with, counts_at, law, setup, stage

from hil.lanes.fast import run_block
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.trajectory import Move, Trajectory


def in_the_middle() -> Rows:
    """60 ticks under feedback at mid-workspace: noise, lost frames, a jump that saturates the combs, a fault."""
    at = stage().forward_kinematics(MIDDLE)
    reference = np.tile(np.r_[at, np.zeros(6)], (80, 1))
    reference[47:, 2] -= 20e-6
    c = Cycle(law(autostart=False), reference, Mode.ENABLED)
    memory, drive = c.memory["tick"][0], c.law["tick"]["drive"][0]
    memory["count"][:] = np.round(stage().holding_voltages(at) / drive["volt_per_count"]).astype(np.int32)
    for name in ("predicted", "filtered", "ahead"):
        memory["estimate"][name][:3] = at - c.law["tick"]["estimator"]["operating_point_m"][0]
    noise = np.random.default_rng(1).integers(-8, 9, (60, 3))
    rows = []
    for k in range(60):
        lost = k in (20, 21) or k >= 50
        event = Event.TRACK if k == 0 else Event.NONE
        rows.append(c.tick(counts_at(MIDDLE) + noise[k], status=1 if lost else 0, event=event))
    return np.array(rows, ROW)


def from_rest() -> Rows:
    """80 ticks on the nominal plant: 20 of homing, then a move upwards."""
    brief = design_law(stage(), controller_with(homing_s=0.004), bus(), autostart=True)
    limits = {"velocity_max_m_per_s": 1e-3, "acceleration_max_m_per_s2": 1.0, "jerk_max_m_per_s3": 1000.0}
    move = Move.model_validate({"kind": "move", "to_m": (0.2e-6, -0.1e-6, 4e-6), **limits})
    plant, memory, rows = setup().new_plant(), new_memory(Mode.IDLE), np.zeros(80, ROW)
    reference, sample_us = reference_rows(Trajectory([move]).sample(0, 90, 200)), np.arange(80, dtype=np.int64) * 200
    run_block(brief, memory, reference, plant.params, plant.state, sample_us, rows, 80)
    return rows


if __name__ == "__main__":
    np.save(sys.argv[1], np.concatenate([in_the_middle(), from_rest()]))
