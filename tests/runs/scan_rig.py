"""Errors of a scan that a run makes again and again, on the fast lane."""

import dataclasses

import numpy as np

from hil.lanes import in_process
from hil.lanes.lane import Lane
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.trajectory import Circle, Raster, Trajectory


def scan_errors(scenario, seed, scans=1, *, learn=None, without=None, **files):
    """True position less reference (n, 3), m, of each scan; and when it began after the first, s. ``learn`` instead of
    what the controller says; ``without`` of the plant; ``files`` as of ``load_scenario``.
    """
    loaded = load_scenario(scenario, seed=seed, **files)
    segments = loaded.config.reference
    (at,) = (i for i, s in enumerate(segments) if isinstance(s, Raster | Circle))
    trajectory = Trajectory([*segments[:at], *[segments[at]] * scans, *segments[at + 1 :]])
    controller = loaded.controller if learn is None else loaded.controller.model_copy(update={"learn": learn})
    plant = loaded.plant.model_copy(update=without or {})
    duration_s = trajectory.duration_us * 1e-6 + 0.1  # of start-up
    setup = dataclasses.replace(
        dataclasses.replace(loaded, controller=controller, plant=plant).setup(),
        trajectory=trajectory, duration_s=duration_s,
    )  # fmt: skip
    blocks = []
    result = in_process.run(setup, Lane.FAST, on_block=lambda rows: blocks.append(rows.copy()))
    assert not result.faults
    rows = np.concatenate(blocks)
    t_us = rows["reference_tick"] * setup.bus.period_us
    windows = [s.scan_us for s in trajectory.segments if s.scan_us]
    errors_m = []
    for begin_us, end_us in windows:
        scan = rows[(t_us >= begin_us) & (t_us < end_us)]
        errors_m.append(scan["position_m"] - scan["reference_m"])
    return errors_m, [(begin_us - windows[0][0]) * 1e-6 for begin_us, _ in windows]


def rms_m(error_m):
    """(3,)"""
    return np.sqrt(np.mean(error_m**2, axis=0))


def over_seeds(values_m):
    """Quadratic mean (3,), nm, of what the seeds have (n, 3)."""
    return 1e9 * np.sqrt(np.mean(np.square(values_m), axis=0))
