"""The numbers of the adaptation: the filter's axes, each by itself, and how far devices differ."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.core import adaptation as learning
from pkxyz_ctrl.design.device_errors import spreads, within
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

FRINGE_M = 25e-6
"""Stroke over which growth of a comb's pull is counted."""


def fill_adaptation(tick: Any, stage: Stage, controller: ControllerConfig, bus: BusConfig, variance_m2: Array) -> None:
    """Fill ``tick["adaptation"]``; ``tick["estimator"]`` is there already, and the (3,3) of its innovations."""
    record, filter_, config = tick["adaptation"][0], tick["estimator"][0], controller.adaptation
    phi, gamma = np.vstack([filter_["transition"], np.eye(9)[6:]]), np.vstack([filter_["input"], np.zeros((3, 3))])
    for axis in range(3):
        keep = slice(axis, None, 3)
        record["transition"][axis], record["input"][axis] = phi[keep, keep], gamma[keep, axis]
        record["gain"][axis], record["variance_m2"][axis] = filter_["gain"][keep, axis], variance_m2[axis, axis]
    record["sense_delay_s"] = filter_["sense_delay_s"]
    spread = spreads(controller, stage)
    record["spread"][: learning.PARAMETERS] = spread
    most = np.full(learning.PARAMETERS, config.most_relative)
    most[learning.DAMPING], most[learning.DELAY] = config.most_damping, config.most_delay_s
    most[learning.BEND] = 4.0 * spread[learning.BEND]
    record["bound"][: learning.PARAMETERS], record["doubt"] = most / spread, config.doubt
    record["drift"] = config.drift_per_rts**2 * bus.period_s
    record["follow"] = min(1.0, bus.period_s / config.follow_s)
    record["least"] = config.least_told
    record["near_m"] = config.near_m
    lag_s = filter_["sense_delay_s"]  # beyond its square, a lag shows by its cube times the jerk: less than the noise
    record["turn_m_per_s2"] = np.sqrt(record["variance_m2"]) * bus.period_s / lag_s**3 if lag_s > 0.0 else np.inf
    record["calm_ticks"] = max(1, round(config.calm_s / bus.period_s))
    record["fringe_m"] = FRINGE_M
    record["base_updates"] = max(1, round(config.base_s / bus.period_s))
    record["warn"], record["alone"] = config.warn_relative, config.alone
    record["forget"] = min(1.0, bus.period_s / config.forget_s)
    start = config.start
    record["start"] = 0.0 if start is None else np.array(start.values) / spread
    record["start_covariance"] = np.eye(learning.PARAMETERS) if start is None else within(start, spread)
    record["known"] = start is not None
    record["on"] = controller.learn == "online"
