"""What the kernel takes to hand a datagram to a process that sleeps: of a loop's answer, what no loop can save."""

import contextlib
import os
import socket
import subprocess
import sys
import time

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.io.realtime import FIFO_PRIORITY, leave_real_time

SENDS, APART_S, DATAGRAM = 4000, 250e-6, bytes(22)
_SLEEPER = """
import contextlib, os, socket, sys
with contextlib.suppress(OSError):
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(sys.argv[2])))
with socket.socket(fileno=int(sys.argv[1])) as end:
    end.send(b"")
    while end.recv(64):
        pass
"""


def waking_sends_us() -> NDArray[np.float64]:
    """The time of each ``send`` to a process at the other end of a Unix socket that waits in ``recv`` as the plant's
    does; both at real-time priority, where this user may.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    words = [sys.executable, "-c", _SLEEPER, str(theirs.fileno()), str(FIFO_PRIORITY)]
    taken_ns = np.empty(SENDS)
    with ours, subprocess.Popen(words, pass_fds=(theirs.fileno(),)) as sleeper:
        theirs.close()
        try:
            ours.recv(64)  # it is there
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
            for number in range(SENDS):
                time.sleep(APART_S)
                begin_ns = time.perf_counter_ns()
                ours.send(DATAGRAM)
                taken_ns[number] = time.perf_counter_ns() - begin_ns
            ours.send(b"")
        finally:
            leave_real_time()
            sleeper.kill()
    return taken_ns * 1e-3
