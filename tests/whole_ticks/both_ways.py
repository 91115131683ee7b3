"""Every case of the fault matrix in whole ticks and event by event, under laws and on buses: the same rows, voltages
behind each tick, decisions and words. Some minutes a law and bus.

    python tests/whole_ticks/both_ways.py [--law LAW]... [--bus BUS]... [--lasting]
"""

import argparse
import dataclasses
import sys

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.studies.faults.matrix import CASES, CLEAR_S, Case
from hil.studies.faults.outcome import setup_for

LAWS = "lqg", "youla"
BUSES = "fd_5k", "classic_2k", "unix_1k"


def played(setup: Setup, *, whole: bool) -> tuple[bytes, list[tuple[float, float, float]] | None, list[str]]:
    """Rows, voltages behind each tick, and words of a run."""
    blocks: list[NDArray[np.void]] = []
    rig = LockstepRig(setup, whole_ticks=whole)
    assert rig.injection is not None
    rig.injection.watched = []
    rig.run(
        Blocks(setup.trajectory, setup.bus.period_us, setup.ticks, lambda b: blocks.append(b.copy()), lambda *_: None)
    )
    return b"".join(block.tobytes() for block in blocks), rig.injection.watched, rig.controller.faults


def differs(setup: Setup, case: Case) -> bool:
    """Whether a case is not the same both ways."""
    run = dataclasses.replace(setup, faults=(case.on(setup.bus.period_us).fault,), clear_s=CLEAR_S)
    vars(run)["law"] = setup.law  # designed once
    return played(run, whole=True) != played(run, whole=False)


def main() -> int:
    """0 if all are the same."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--law", action="append")
    parser.add_argument("--bus", action="append")
    parser.add_argument("--lasting", action="store_true", help="faults that never end")
    asked = parser.parse_args()
    different = done = 0
    for law in asked.law or LAWS:
        for bus in asked.bus or BUSES:
            setup = setup_for(law, bus=bus)
            for case in CASES:
                case = case.lasting if asked.lasting else case
                if differs(setup, case):
                    different += 1
                    print(f"{law}, {bus}, {case.text}: not the same")
                done += 1
    print(f"{done} cases both ways, {different} different")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
