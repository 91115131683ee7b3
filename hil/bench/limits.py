"""What this machine can do at best, whatever the program: the floor under every other figure."""

import numpy as np

from hil.bench.rigs.closed_loop import scan
from hil.bench.rigs.figure import Figure, calls
from hil.bench.rigs.kernels import no_argument, one_array, three_arrays, two_arrays
from hil.bus.frame_time import INTERFRAME_BITS, frame_range_us
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.loop.reference import REFERENCE


def limits() -> list[Figure]:
    """An empty call of Python, of a compiled function, and of one with the arrays that a tick takes."""
    loop = scan()

    def empty() -> None:
        pass

    names = {
        "empty": empty, "none": no_argument, "one": one_array, "two": two_arrays, "three": three_arrays,
        "law": loop.setup.law, "memory": loop.memory.copy(), "reference": np.zeros(8, REFERENCE),
    }  # fmt: skip
    statements = {
        "python_call": "empty()",
        "compiled_call": "none()",
        "compiled_call_1_array": "one(memory)",
        "compiled_call_2_arrays": "two(law, memory)",
        "compiled_call_3_arrays": "three(law, memory, reference)",
    }
    words = {
        "python_call": "an empty function of Python",
        "compiled_call": "an empty compiled function",
        "compiled_call_1_array": "with one structured array",
        "compiled_call_2_arrays": "with two structured arrays",
        "compiled_call_3_arrays": "with the three arrays of a tick, of which this is the part that no kernel can save",
    }
    taken = calls(statements, names, 20_000, 11)
    return [Figure(f"limits.{k}", t.per(1)[0], "us", None, None, t.per(1)[1], words[k]) for k, t in taken.items()]


def bus_cycle() -> list[Figure]:
    """The shortest period that the frames of the default bus allow, if computing takes what the bus file says.

    SYNC, the sense PDO at once behind its interframe space, the drive PDO when the controller has computed: frame times
    by the arithmetic of ISO 11898-1, for the longest frames that any data make.
    """
    bus = scan().setup.bus
    assert bus.can is not None
    can, node_id = bus.can, bus.can.driver.node_id
    assert can.data_bitrate_bit_per_s is not None
    rates = can.nominal_bitrate_bit_per_s, can.data_bitrate_bit_per_s
    frames = ((cob_id.SYNC, 1), (cob_id.SENSE_BASE + node_id, 8), (cob_id.DRIVE_BASE + node_id, 8))
    ranges = [frame_range_us(can_id, length, *rates, is_fd=True) for can_id, length in frames]
    gap_us = INTERFRAME_BITS * 1e6 / rates[0]  # within which response time and computing are free
    waits_us = max(0.0, can.turnaround_us - gap_us) + max(0.0, can.compute_us - gap_us)
    shortest, longest = (sum(r[k] for r in ranges) + waits_us for k in (0, 1))
    return [
        Figure("bus.cycle", longest, "us", float(bus.period_us), "at most", None,
               f"{shortest:.0f} us with the shortest frames; so the wire would allow {1e3 / longest:.1f} kHz"),
        Figure("bus.room", bus.period_us - longest + can.compute_us, "us", None, None, None,
               "what a tick may take from sense frame to drive frame, with the longest frames"),
    ]  # fmt: skip
