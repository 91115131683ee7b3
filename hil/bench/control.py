"""What the loop reaches on ``fd_5k`` with 2 nm of sense noise a sample: bandwidth, steps, circle, raster, hold, limits.

The nominal plant, the fast lane (whose bits are those of the lockstep lane), true position against reference.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.bench.rigs.answers import BAND_M, STEP_M, Settled, jump_settled, move_settled, sine_response
from hil.bench.rigs.figure import Figure
from hil.bench.rigs.held import HOLD_S, STROKES_M, held_nm, shortest_step_s
from hil.bench.rigs.motions import MIDDLE_M, Run, error_m, run, settled_s, setup_of
from hil.bench.rigs.predictive import LOW_M, TOLERANCE, WAY_M, mpc_ticks_us, osqp_us, solver_us
from hil.studies.margins.loop import Loop
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.hold_floor import hold_floor_m, rounding_floor_m
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Circle, Hold, Raster, Steps

LAW, OPEN_LOOP = "youla", "open_loop"
"""The default law, and what every figure that there is without feedback stands beside."""
SHAKEN_M_PER_S2 = 98.1e-6
"""10 ug/rtHz of the base, one-sided."""


def control() -> list[Figure]:
    """All of it with the default law, and the far jump with mpc beside lqg."""
    motion = [*_bandwidth(), *_steps(), *_jumps(), _circle(), _raster(), _hold()]
    return [*motion, *_at_limits(), *_far_jump(), *_mpc_ticks()]


def _bandwidth() -> list[Figure]:
    figures = []
    for name, frequency_hz, target in (("gain_631", 631.0, 1.0), ("gain_1262", 1262.0, -0.7)):
        gain_db, words = _gain(frequency_hz, LAW)
        detail = f"100 nm sine at {frequency_hz:g} Hz: {words}; open loop {_gain(frequency_hz, OPEN_LOOP)[1]}"
        if target > 0:
            value = max(abs(v) for v in gain_db)
            figures.append(Figure(f"control.{name}", value, "dB off", target, "at most", None, detail))
        else:
            figures.append(Figure(f"control.{name}", min(gain_db), "dB", target, "at least", None, detail))
    return figures


def _gain(frequency_hz: float, law: str) -> tuple[list[float], str]:
    found = [sine_response(axis, frequency_hz, law) for axis in "xy"]
    gain_db = [float(20 * np.log10(abs(g))) for g in found]
    each = zip("xy", gain_db, np.degrees(np.angle(found)), strict=True)
    return gain_db, ", ".join(f"{axis} {db:+.2f} dB, {turn:+.1f} deg" for axis, db, turn in each)


def _steps() -> list[Figure]:
    words = "1 um from point to point on each axis, to and fro, ten times: the worst"
    return _settling("step", move_settled, 1.4, words, "from its start to 10 nm")


def _jumps() -> list[Figure]:
    words = "1 um on each axis as a jump of the set-point, which no stage can follow, six times: the worst"
    return _settling("jump", jump_settled, 1.0, words, "to 10 nm")


def _settling(name: str, settled: Callable[[str], Settled], target_ms: float, words: str, until: str) -> list[Figure]:
    ours, nothing, least_s = settled(LAW), settled(OPEN_LOOP), shortest_step_s(STEP_M, BAND_M)
    time = (
        f"{words}; {until}, {ours.s / least_s:.2f} times the shortest that voltage and slew allow; "
        f"open loop {nothing.s * 1e3:.1f} ms"
    )
    beyond = f"{words}; open loop {nothing.beyond * 100:.1f} %"
    return [
        Figure(f"control.{name}_settle", ours.s * 1e3, "ms", target_ms, "at most", None, time),
        Figure(f"control.{name}_overshoot", ours.beyond * 100, "%", 5.0, "at most", None, beyond),
    ]


def _rms_nm(errors_m: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.atleast_2d(errors_m) ** 2, axis=-1)))) * 1e9


def _each_nm(errors_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.mean(errors_m**2, axis=0)) * 1e9)


def _circle() -> Figure:
    circle = [Circle(kind="circle", radius_m=4e-6, frequency_hz=100.0, turns=50.0)]
    ours, nothing = (_rms_nm(error_m(run(circle, law).scan(0))[:, :2]) for law in (LAW, OPEN_LOOP))
    detail = f"radius 4 um, 100 Hz, in the plane: {ours:.2f} nm of 8 um; open loop {nothing:.2f}"
    return Figure("control.circle", ours / 8e3 * 100, "% of diameter", 0.1, "at most", None, detail)


def _raster() -> Figure:
    lines = Raster(
        kind="raster", line_length_m=10e-6, lines=20, line_pitch_m=0.2e-6, line_rate_hz=50.0,
        velocity_max_m_per_s=2e-3, acceleration_max_m_per_s2=1.0, jerk_max_m_per_s3=1000.0,
    )  # fmt: skip
    ours, nothing = (_on_lines_nm(run([lines], law)) for law in (LAW, OPEN_LOOP))
    detail = f"20 lines of 10 um, 50 lines/s: {_three(ours)} nm in x, y, z on the lines; open loop {_three(nothing)}"
    return Figure("control.raster", float(ours.max()) / 10e3 * 100, "% of line", 0.1, "at most", None, detail)


def _on_lines_nm(motion: Run) -> NDArray[np.float64]:
    return _each_nm(np.concatenate([error_m(motion.during(window)) for window in motion.segments[0].lines_us]))


def _hold() -> Figure:
    ours, nothing = (_still_nm(run([Hold(kind="hold", duration_s=1.0)], law)) for law in (LAW, OPEN_LOOP))
    bus = load("buses", "fd_5k", BusConfig)
    floor = 1e9 * rounding_floor_m(Stage.load("reconstructed"), bus, STROKES_M)
    detail = (
        f"true position against the set-point at mid-workspace, 1 s: {_three(ours)} in x, y, z, "
        f"{(ours / floor).max():.1f} times the least of any linear law, {_three(floor)}, with rounding, white, as all "
        f"that disturbs; open loop {_three(nothing)}"
    )
    return Figure("control.hold", float(ours.max()), "nm rms", 1.0, "at most", None, detail)


def _still_nm(motion: Run) -> NDArray[np.float64]:
    return _each_nm(error_m(motion.during(motion.segments[0].still_us or (0, 0))))


def _at_limits() -> list[Figure]:
    """Quiet holds, a shaken base, disturbances at 10 and 50 Hz, idle tones, and the shortest step."""
    return [_quiet(), *_shaken(), *_rejection(), _idle_tones(), _shortest_step()]


def _quiet() -> Figure:
    ours, nothing = held_nm(LAW, quiet=True)[0], held_nm(OPEN_LOOP)[0]
    detail = f"hold about the set-point, quiet: {_three(ours)}; open loop {_three(nothing)}"
    return Figure("control.hold_quiet", float(ours.max()), "nm rms", 0.8, "at most", None, detail)


def _shaken() -> list[Figure]:
    bus = load("buses", "fd_5k", BusConfig)
    floor = 1e9 * hold_floor_m(Stage.load("reconstructed"), bus, STROKES_M, SHAKEN_M_PER_S2)
    nothing, figures = held_nm(OPEN_LOOP, shaken_m_per_s2=SHAKEN_M_PER_S2)[1], []
    for name, quiet in (("shaken_quiet", True), ("shaken", False)):
        ours = held_nm(LAW, quiet=quiet, shaken_m_per_s2=SHAKEN_M_PER_S2)[1]
        detail = (
            f"deviation on a base of 10 ug/rtHz{', quiet' if quiet else ''}: {_three(ours)} nm over the least of any "
            f"linear law, {_three(floor)}; open loop {_three(nothing)}. Rejection to 200 Hz alone costs a factor of 1.9"
        )
        figures.append(
            Figure(f"control.hold_{name}", float((ours / floor).max()), "x floor", 1.25, "at most", None, detail)
        )
    return figures


def _rejection() -> list[Figure]:
    setup, _ = setup_of([Hold(kind="hold", duration_s=HOLD_S)], LAW, "nominal", MIDDLE_M)
    loop = Loop(Stage(setup.stage), setup.bus, setup.law)
    hz, figures = np.array([10.0, 50.0]), []
    s = np.abs(loop.response(STROKES_M, hz).s)
    for at, target, of_axes in zip(hz, (34.0, 20.0), np.diagonal(s, axis1=1, axis2=2), strict=True):
        down = -20.0 * np.log10(of_axes)
        detail = f"a disturbance at {at:g} Hz is weaker than without feedback, 0 dB, by {_three(down)} dB in x, y, z"
        figures.append(Figure(f"control.reject_{at:g}", float(down.min()), "dB", target, "at least", None, detail))
    return figures


def _idle_tones() -> Figure:
    ours, nothing = held_nm(LAW, quality=200.0)[0], held_nm(OPEN_LOOP, quality=200.0)[0]
    detail = f"open-loop hold at a quality factor of 200: {_three(nothing)}; the default law {_three(ours)}"
    return Figure("control.idle_tones", float(nothing[2]), "nm rms", 1.0, "at most", None, detail)


def _shortest_step() -> Figure:
    detail = "from the jump of the set-point to within 10 nm of 1 um for good, whatever drove it: slew, voltage, delay"
    return Figure("control.step_limit", shortest_step_s(STEP_M, BAND_M) * 1e3, "ms", None, None, None, detail)


def _three(values: NDArray[np.float64]) -> str:
    return " / ".join(f"{v:.2f}" for v in values)


def far_jump(controller: str) -> dict[str, Any]:
    """A jump over nearly the whole height, there and back: settling of each in ms, and how near the limits it came."""
    motion = run([Steps(kind="steps", by_m=(0.0, 0.0, WAY_M), count=1, dwell_s=0.04)], controller, height_m=LOW_M)
    period_us = motion.period_us
    times = [
        settled_s(motion.during((at, at + 36_000)), 2, BAND_M, period_us * 1e-6) * 1e3
        for at in motion.segments[0].jumps_us
    ]
    rows = motion.during((motion.segments[0].t_start_us, motion.segments[0].t_end_us))
    solved = rows["solver_iterations"]
    return {
        "settle_ms": times, "voltage_max_v": float(rows["voltage_v"].max()),
        "step_max_v": float(np.abs(np.diff(rows["voltage_v"], axis=0)).max()),
        "stroke_max_um": float(rows["stroke_m"].max()) * 1e6, "stroke_min_um": float(rows["stroke_m"].min()) * 1e6,
        "saturated": int(rows["saturated"].sum()),
        "solved": int((solved > 0).sum()), "gave_up": int((solved < 0).sum()),
    }  # fmt: skip


def _far_jump() -> list[Figure]:
    clipped, planned = far_jump("lqg"), far_jump("mpc")
    inside = (
        planned["voltage_max_v"] <= 200.0 and planned["step_max_v"] <= 20.0
        and planned["stroke_max_um"] <= 25.0 and planned["stroke_min_um"] >= -0.5
    )  # fmt: skip
    there_and_back = {n: " and ".join(f"{t:.1f}" for t in d["settle_ms"]) for n, d in (("l", clipped), ("p", planned))}
    later = max(p - c for p, c in zip(planned["settle_ms"], clipped["settle_ms"], strict=True))
    return [
        Figure("control.mpc_settle", later, "ms", 0.0, "at most", None,
               f"4 to 35 um of height and back, less than lqg takes, the worse of the two directions: "
               f"mpc {there_and_back['p']} ms, lqg {there_and_back['l']} ms, {clipped['saturated']} ticks at a limit"),
        Figure("control.mpc_violations", 0.0 if inside else 1.0, "count", 0.0, "at most", None,
               f"{planned['voltage_max_v']:.1f} of 200 V, {planned['step_max_v']:.2f} of 20 V a tick, "
               f"strokes {planned['stroke_min_um']:.2f} to {planned['stroke_max_um']:.2f} of 0 to 25 um; solved "
               f"{planned['solved']} times, gave up {planned['gave_up']} times"),
    ]  # fmt: skip


def _mpc_ticks(repeats: int = 15) -> list[Figure]:
    """Ticks that solve a problem, and the solver beside OSQP: the least of several runs, as others only lengthen it."""
    every, solved, posed = mpc_ticks_us(repeats)
    detail = (
        f"the {len(posed.works)} ticks of a far jump that solve a problem, each whole, Python included, the least of "
        f"{repeats} runs with the same bits: median {np.percentile(solved, 50):.0f} us, longest {solved.max():.0f} us; "
        f"all ticks: median {np.percentile(every, 50):.1f} us, p99 {np.percentile(every, 99):.0f} us"
    )
    own, other = solver_us(posed, repeats), osqp_us(posed, repeats)
    beside = (
        f"OSQP's time for these problems to {TOLERANCE:g}, started from the one before, over ours for the exact "
        f"solution: medians {np.median(other):.0f} and {np.median(own):.1f} us, "
        f"p99 {np.percentile(other, 99):.0f} and {np.percentile(own, 99):.1f} us"
    )
    return [
        Figure("control.mpc_tick", float(np.percentile(solved, 99)), "us at p99", 20.0, "at most", None, detail),
        Figure("control.mpc_over_osqp", float(np.median(other) / np.median(own)), "times", None, None, None, beside),
    ]
