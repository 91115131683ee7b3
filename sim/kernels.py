"""The plant in compiled form: ``advance``, ``drive`` and ``sample`` on one record of parameters and one of state.

The same arithmetic whether called from Python (``sim.plant.Plant``) or from another compiled loop."""

import math

import numpy as np

from sim.motion.amplifier import charge, drive, plan, snap, snapped
from sim.motion.collocation import regular_step
from sim.motion.integrator import step
from sim.motion.kernel import kernel
from sim.motion.layout import BROKEN, BROWNIAN_STREAM, DRIFT_STREAM, EVENTS, PULLED_IN, STOP
from sim.motion.noise import normal
from sim.motion.parasitic import parasitic_step
from sim.sense import follow, follow_voltages, pass_noise, sample, walk
from sim.structure.general_step import general_step
from sim.structure.pose import combs_seen
from sim.structure.side import balance
from sim.surroundings.call_forces import surround
from sim.surroundings.slow import grow_old

__all__ = ["advance", "drive", "sample"]

REACH_M = 300e-6
"""Further than this from rest, on any axis, no flexure is whole: the stage is broken and stays where it was."""


@kernel
def note(s: np.void, kind: int, chain: int) -> None:
    """Add an event, at the end of the step in which it happens."""
    n = s["event_count"]
    if n < EVENTS:
        s["event_t_us"][n] = s["t_us"]
        s["event_kind"][n] = kind
        s["event_chain"][n] = chain
    s["event_count"] = n + 1


@kernel
def _constant_forces(p: np.void, s: np.void, dt_s: float) -> None:
    """External, weight, drift and thermal force of the coming step, held over it."""
    for j in range(3):
        s["force_n"][j] = s["external_n"][j] + p["weight_n"][j]
    if p["drift_on"] != 0:
        grown = 1.0 - math.exp(-1e-6 * s["t_us"] / p["drift_s"])
        size = p["drift_walk_n_per_rt_s"] * math.sqrt(dt_s)
        for j in range(3):
            s["drift_walk_n"][j] += size * normal(s["random"][DRIFT_STREAM], s["spare"][DRIFT_STREAM])
            s["force_n"][j] += p["drift_n"][j] * grown + s["drift_walk_n"][j]
    if p["brownian_n_rt_s"][0] > 0.0:
        for j in range(3):
            size = p["brownian_n_rt_s"][j] / math.sqrt(dt_s)
            s["force_n"][j] += size * normal(s["random"][BROWNIAN_STREAM], s["spare"][BROWNIAN_STREAM])


@kernel
def _whole(motion: np.ndarray) -> bool:
    """False if the table is out of reach or not a number."""
    return bool(abs(motion[0]) < REACH_M and abs(motion[1]) < REACH_M and abs(motion[2]) < REACH_M)


@kernel
def _note_contacts(s: np.void) -> None:
    """An event where a slider that did not touch its stop in the last step does now."""
    for i in range(3):
        if s["touched"][i] != s["touching"][i]:
            s["touching"][i] = s["touched"][i]
            if s["touched"][i] != 0:
                note(s, STOP, i)


@kernel
def _move(p: np.void, s: np.void, total_s: float) -> None:
    """Rigid motion, parasitic mode and voltages over total_s, from switch to switch of the amplifier."""
    remaining = total_s
    while remaining > 0.0:
        duration = plan(p, s, remaining)
        n, h = 1, duration
        if duration > p["longest_s"]:  # seldom: two divisions, for which all that follows would wait
            n = math.ceil(duration / p["longest_s"])
            h = duration / n
        for k in range(n):
            if p["crosstalk_on"] != 0 and p["sense_filter_s"] > 0.0:
                follow_voltages(p, s, h)
            if p["parasitic_on"] != 0:
                parasitic_step(p, s, h)
            if p["general_on"] != 0:
                _general(p, s, h, remaining - (k + 1) * h)
            elif s["broken"] == 0 and (h != p["regular_s"] or not regular_step(p, s)):
                step(p, s, h)
            if s["broken"] != 0 or not _whole(s["motion"]):
                _break(s)
            chain = snapped(p, s)
            while chain >= 0:
                _note_snap(s, chain)
                chain = snapped(p, s)
        remaining -= duration
        if remaining < 1e-15:
            remaining = 0.0


@kernel
def _general(p: np.void, s: np.void, h: float, left_s: float) -> None:
    """A general step, fingers' balance and memory of the sense chain with it; ``left_s`` of the call follow."""
    remembers = p["sense_filter_s"] > 0.0 or p["sense_delay_us"] > 0.0
    if remembers:
        combs_seen(p, s, s["before_m"], s["before_m_per_s"])
    if s["broken"] == 0:
        general_step(p, s, h)
    if p["misaligned_on"] != 0 and s["broken"] == 0:
        chain = balance(p, s)
        while chain >= 0:
            snap(s, chain)
            _note_snap(s, chain)
            chain = balance(p, s)
    if remembers:
        follow(p, s, h, s["t_us"] - 1e6 * left_s)


@kernel
def _note_snap(s: np.void, chain: int) -> None:
    """Fingers of a chain have snapped together."""
    note(s, PULLED_IN, chain)
    s["base_v"][chain], s["error_v"][chain], s["slope_v_per_s"][chain] = 0.0, 0.0, 0.0


@kernel
def _break(s: np.void) -> None:
    """The stage stays where this step began; its combs are dead."""
    if s["broken"] == 0:
        s["broken"] = 1
        note(s, BROKEN, -1)
        for j in range(3):
            s["motion"][j] = s["start"][j]
            s["motion"][3 + j] = 0.0
        s["modes"][:] = 0.0
    for i in range(3):
        s["voltage_v"][i] = 0.0
        s["base_v"][i], s["slope_v_per_s"][i], s["error_v"][i] = 0.0, 0.0, 0.0


@kernel
def advance(params: np.ndarray, state: np.ndarray, dt_us: int) -> None:
    """Integrate over dt_us microseconds with what the converters hold now; nothing for dt_us <= 0."""
    if dt_us <= 0:
        return
    p = params[0]
    s = state[0]
    dt_s = dt_us * 1e-6
    remembers = p["general_on"] == 0 and (p["sense_filter_s"] > 0.0 or p["sense_delay_us"] > 0.0)
    if remembers:
        combs_seen(p, s, s["before_m"], s["before_m_per_s"])
    if p["slow_on"] != 0:
        grow_old(p, s["t_us"])
    _constant_forces(p, s, dt_s)
    if p["general_on"] != 0:
        surround(p, s, dt_us)
        for j in range(3):
            s["steady_n"][j], s["force_n"][j] = s["force_n"][j], 0.0
    s["t_us"] += dt_us
    for i in range(3):
        s["touched"][i] = 0
    _move(p, s, dt_s)
    _note_contacts(s)
    if p["charging_on"] != 0:
        charge(p, s, dt_s)
    if p["sense_walk_f_per_rt_s"] > 0.0:
        walk(p, s, dt_s)
    if p["sense_chain_noise_f"] > 0.0:
        pass_noise(p, s, dt_s)
    if remembers:
        follow(p, s, dt_s, float(s["t_us"]))
