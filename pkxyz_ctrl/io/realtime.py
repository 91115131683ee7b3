"""Asks the operating system for what a loop at rate needs, and says what it did not get. Never a failure."""

import ctypes
import gc
import os
import sys
from pathlib import Path

FIFO_PRIORITY = 80  # above the kernel's threaded interrupts (50), as cyclictest's customary 80
_LOCK_CURRENT, _LOCK_FUTURE, _LOCK_ON_FAULT = 1, 2, 4  # sys/mman.h: MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT
_SET_TIMER_SLACK = 29  # linux/prctl.h: PR_SET_TIMERSLACK
_AWAKE = Path("/dev/cpu_dma_latency")  # Linux, PM QoS: latency of a core's waking that is borne, while it is open
_awake: list[int] = []


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def settle_memory() -> None:
    """Collect garbage once, then never again: what is left is there to stay. Call when everything is set up."""
    gc.collect()
    gc.freeze()
    gc.disable()


def go_real_time(priority: int = FIFO_PRIORITY) -> str:
    """SCHED_FIFO, memory locked, no timer slack, no core asleep; returns one line that says what this process has and
    what it lacks.
    """
    have: list[str] = []
    lack: list[str] = []
    _set_scheduler(priority, have, lack)
    _lock_memory(have, lack)
    if _libc_call("prctl", _SET_TIMER_SLACK, 1, 0, 0, 0):  # 50 us by default for everyone who is not SCHED_FIFO
        lack.append("timer slack")
    _keep_cores_awake(have, lack)
    got = f"real time: {', '.join(have)}" if have else "real time: nothing"
    return (
        got if not lack else f"{got}; not permitted: {'; '.join(lack)}; the loop runs all the same, later now and then"
    )


def _set_scheduler(priority: int, have: list[str], lack: list[str]) -> None:
    if not hasattr(os, "sched_setscheduler"):
        lack.append(f"SCHED_FIFO (there is none on {sys.platform})")
        return
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        have.append(f"SCHED_FIFO {priority}")
    except OSError:
        lack.append("SCHED_FIFO (needs CAP_SYS_NICE or an rtprio limit in /etc/security/limits.conf)")


def _lock_memory(have: list[str], lack: list[str]) -> None:
    reason = _libc_call("mlockall", _LOCK_CURRENT | _LOCK_FUTURE | _LOCK_ON_FAULT)
    if reason == "":
        have.append("memory locked")
    else:
        lack.append(f"locked memory ({reason}; needs CAP_IPC_LOCK or a memlock limit)")


def _keep_cores_awake(have: list[str], lack: list[str]) -> None:
    """A core that sleeps takes some microseconds to wake: those that a frame's receiver, and this loop, would lose."""
    if sys.platform != "linux":
        return
    try:
        if not _awake:
            _awake.append(os.open(_AWAKE, os.O_WRONLY | os.O_CLOEXEC))
            os.write(_awake[0], (0).to_bytes(4, sys.byteorder))
        have.append("cores awake")
    except OSError as error:
        reason = (error.strerror or "refused").lower()
        lack.append(f"cores awake ({reason}; needs write access to {_AWAKE})")


def _libc_call(name: str, *arguments: int) -> str:
    """Empty if the call went well, else why not."""
    try:
        function = getattr(ctypes.CDLL(None, use_errno=True), name)
    except (OSError, AttributeError):
        return f"no {name} here"
    return "" if function(*map(ctypes.c_ulong, arguments)) == 0 else os.strerror(ctypes.get_errno()).lower()


def leave_real_time() -> None:
    """Back to an ordinary process: for what comes after the loop."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    _libc_call("munlockall")
    while _awake:
        os.close(_awake.pop())
    gc.unfreeze()
    gc.enable()
