"""Rows of a run that never took place: the reference of the default scenario with errors that a test knows."""

import functools

import numpy as np

from hil.lanes.lane import Lane
from hil.runs.run_folder import metadata_of
from hil.runs.scenario import load_scenario, resolve
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode

START_TICKS = 300


@functools.cache
def default_scenario():
    return load_scenario("raster")


def metadata():
    scenario = default_scenario()
    return metadata_of(scenario, Lane.LOCKSTEP, resolve(scenario))


def tracking_rows(seed=1, error_m=1e-9):
    """(n,) of ROW: 60 ms of start-up, then tracking with white errors of ``error_m`` rms on each axis."""
    scenario = default_scenario()
    period_us = scenario.bus.period_us
    count = round(scenario.config.duration_s * 1e6 / period_us)
    random = np.random.default_rng(seed)
    rows = np.zeros(count, ROW)
    rows["tick"] = np.arange(count)
    rows["t_us"] = rows["tick"] * period_us
    rows["reference_tick"] = np.maximum(rows["tick"] - START_TICKS, -1)
    rows["mode"] = np.where(rows["tick"] >= START_TICKS, Mode.TRACKING, Mode.HOMING)
    reference = scenario.trajectory.sample(0, count - START_TICKS, period_us)[:, :3]
    rows["reference_m"][START_TICKS:] = reference
    rows["position_m"] = rows["reference_m"] + random.normal(size=(count, 3)) * error_m
    rows["estimate_m"] = rows["position_m"] + random.normal(size=(count, 3)) * error_m
    rows["comb_voltage_v"] = 130 + random.normal(size=(count, 3))
    rows["drive_count"] = random.integers(0, 32767, size=(count, 3))
    return rows
