"""How long the controller thinks: the whole tick from Python, compiled, and beside filterpy's predict and update."""

import struct
from collections.abc import Callable

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from hil.bench.rigs.closed_loop import ClosedLoop, scan
from hil.bench.rigs.figure import Figure, repeated
from hil.bench.rigs.kernels import replay_cycle
from pkxyz_ctrl.design.laws.estimator_gain import measurement_matrix, measurement_noise, process_noise
from pkxyz_ctrl.design.model.plant_model import amplifier_time_constant_s, linearise, sample
from pkxyz_ctrl.loop.cycle import MEMORY, cycle
from pkxyz_ctrl.stage import Stage

REPEATS = 15
Run = Callable[[], None]
_SEEN = struct.Struct("<7i")  # event, sense_status, node_events, overrun, sense_count, as the controller packs them


def tick() -> list[Figure]:
    """The whole tick: capacitance to voltage with filter, law, allocation, modes, monitors and record.

    Called as the loop calls it: the inputs are packed into the controller's memory, then one compiled call. It replays
    a stretch of the default scan and has to arrive at the voltages that were recorded there, so nothing is left out.
    The same in a compiled loop shows what the call itself costs. filterpy runs its filter alone, with the same model.
    """
    loop = scan()
    taken = repeated(
        {"call": ticks_from_python(loop), "kernel": ticks_compiled(loop), "filterpy": _filterpy_steps(loop)}, REPEATS
    )
    (call, call_m), (kernel, kernel_m), (filterpy, filterpy_m) = (taken[k].per(len(loop.rows)) for k in taken)
    return [
        Figure("tick.call", call, "us", 3.0, "at most", call_m, "the whole tick, called from Python, inputs packed"),
        Figure("tick.over_filterpy", filterpy / call, "times", 5.0, "at least", filterpy_m / call_m,
               f"filterpy's predict + update alone, 9 states, 3 measurements: {filterpy:.1f} us"),
        Figure("tick.kernel", kernel, "us", None, None, kernel_m, "the same compiled as a loop: no call, no packing"),
    ]  # fmt: skip


def ticks_from_python(loop: ClosedLoop) -> Run:
    """All ticks of a stretch, each packed and called as the controller does it."""
    law, reference, memory = loop.setup.law, loop.reference, loop.memory.copy()
    words = [(0, 0, 0, 0, *counts) for counts in loop.rows["sense_count"].tolist()]
    assert MEMORY.fields is not None
    input_at, pack_into = MEMORY.fields["input"][1], _SEEN.pack_into
    view, before = memory.view(np.uint8).data, loop.memory.view(np.uint8).data

    def run() -> None:
        view[:] = before
        for seen in words:
            pack_into(view, input_at, *seen)
            cycle(law, memory, reference)

    return _verified(run, loop, memory)


def ticks_compiled(loop: ClosedLoop) -> Run:
    """All ticks of a stretch in one compiled loop."""
    law, reference, memory = loop.setup.law, loop.reference, loop.memory.copy()
    view, before = memory.view(np.uint8).data, loop.memory.view(np.uint8).data
    sense_count = np.ascontiguousarray(loop.rows["sense_count"])

    def run() -> None:
        view[:] = before
        replay_cycle(law, memory, reference, sense_count)

    return _verified(run, loop, memory)


def _verified(run: Run, loop: ClosedLoop, memory: NDArray[np.void]) -> Run:
    """``run``, once it has shown that it does all the work: it ends at the recorded voltages."""
    run()
    if not np.array_equal(memory["row"]["drive_count"][0], loop.rows["drive_count"][-1]):
        raise RuntimeError("the replayed ticks end at other voltages than the recorded ones: not the same work")
    return run


def _filterpy_steps(loop: ClosedLoop) -> Run:
    """filterpy's predict and update on the same measurements, with the model and noise of the default controller."""
    setup = loop.setup
    stage = Stage(setup.stage)
    model = linearise(stage, np.array(setup.controller.operating_strokes_m))
    kalman = KalmanFilter(dim_x=9, dim_z=3)
    kalman.F = sample(model, setup.bus.period_s, amplifier_time_constant_s(stage)).phi
    _, kalman.Q = process_noise(model, setup.controller.estimator, setup.bus.period_s)
    kalman.H, kalman.R = measurement_matrix(stage), measurement_noise(stage, model, setup.bus)
    kalman.P = 4.0 * kalman.Q
    measured = loop.rows["measurement_m"] - model.position_m

    def run() -> None:
        for z in measured:
            kalman.predict()
            kalman.update(z)

    return run
