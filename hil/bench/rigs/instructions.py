"""How many instructions a tick of the fast lane takes: a process of its own goes through it one by one (Linux).

``python -m hil.bench.rigs.instructions TICKS`` is that process: it stops itself before and behind so many ticks.
"""

import ctypes
import gc
import os
import signal
import subprocess
import sys
from typing import Final

from hil.lanes import many
from hil.lanes.many import Batch
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.compiled.kernel import kernel

BEGIN_TICK: Final = 1500
"""Of the default scenario: it scans."""
_FEW, _MORE = 8, 24
_TRACE_ME, _CONTINUE, _STEP = 0, 7, 9
_PRODUCTS, _LATENCY_CYCLES = 30_000_000, 3


def instructions_per_tick() -> float | None:
    """Of one device, cycle and plant; None where the system does not let a process be gone through."""
    if not sys.platform.startswith("linux"):
        return None
    few, more = _steps(_FEW), _steps(_MORE)
    return None if few is None or more is None else (more - few) / (_MORE - _FEW)


def clock_hz(seconds: float) -> float:
    """Of this core, from the time of ``chain_of_products``: each waits three cycles for the one before."""
    return _PRODUCTS * _LATENCY_CYCLES / seconds


def chain_of_products() -> int:
    """What is timed for it."""
    return int(_chain(_PRODUCTS))


@kernel
def _chain(products: int) -> int:
    found = 3
    for _ in range(products):
        found = found * found
    return found


def _steps(ticks: int) -> int | None:
    """Instructions between the two stops of such a process."""
    words = [sys.executable, "-W", "ignore", "-m", "hil.bench.rigs.instructions", str(ticks)]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        if not _stops_itself(process.pid):
            return None
        taken = -1
        while _goes_on(process.pid, _STEP):
            taken += 1
            _, status = os.waitpid(process.pid, 0)
            if not os.WIFSTOPPED(status):
                return None
            if os.WSTOPSIG(status) == signal.SIGSTOP:
                return taken
        return None
    finally:
        process.kill()
        process.wait()


def _stops_itself(pid: int) -> bool:
    """From the start; other signals than the one that it sends itself are let go."""
    while True:
        _, status = os.waitpid(pid, 0)
        if not os.WIFSTOPPED(status):
            return False
        if os.WSTOPSIG(status) == signal.SIGSTOP:
            return True
        if not _goes_on(pid, _CONTINUE):
            return False


def _goes_on(pid: int, request: int) -> bool:
    return _trace(request, pid) == 0


def _trace(request: int, pid: int) -> int:
    call = ctypes.CDLL(None).ptrace
    call.argtypes, call.restype = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p], ctypes.c_long
    return int(call(request, pid, None, None))


def main(ticks: int) -> None:
    """The ticks, between two stops."""
    setup = load_scenario("raster").setup()
    batch = Batch.of(setup, setup.law, [setup.new_plant()])
    many.run_one_after_another(batch._replace(at_us=batch.at_us[:BEGIN_TICK]))
    counted = batch._replace(at_us=batch.at_us[BEGIN_TICK : BEGIN_TICK + ticks])
    gc.disable()
    if _trace(_TRACE_ME, 0) != 0:
        sys.exit(1)
    os.kill(os.getpid(), signal.SIGSTOP)
    many.run_one_after_another(counted)
    os.kill(os.getpid(), signal.SIGSTOP)


if __name__ == "__main__":
    main(int(sys.argv[1]))
