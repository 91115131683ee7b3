"""Process frames and the gate over two records, as a board calls them: what is sensed goes in, what may be sent comes
out. The rules are those of ``can.sense_input``, ``can.process_pdo`` and ``safety.gate_rules``; here they meet a frame.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.can import process_pdo, sense_input
from pkxyz_ctrl.can.cob_id import sense as sense_id
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import FD_FAST
from pkxyz_ctrl.safety import gate_rules
from pkxyz_ctrl.safety.gate import GateConfig

Records = NDArray[np.void]

WIRE = np.dtype(
    [
        ("gate", gate_rules.GATE, (1,)),
        ("sense", sense_input.SENSE, (1,)),
        ("drive", process_pdo.PDO, (1,)),
        ("flags", "i4"),  # of the frames that we send
    ],
    align=True,
)

WIRE_MEMORY = np.dtype([("gate", gate_rules.GATE_MEMORY, (1,)), ("sense", sense_input.SENSE_MEMORY, (1,))], align=True)

FRAME = np.dtype(
    [
        ("t_us", "i8"),  # when it is to be sent
        ("data", "i8"),  # its first eight bytes as they lie in memory, little endian
        ("can_id", "i4"),
        ("flags", "i4"),  # 1: FD, 2: with bit-rate switch; anything else is refused
        ("length", "i4"),
        ("mode", "i4"),  # of the controller
        ("counter", "i4"),  # alive counter of the drive frame that is to be made, 0..255, one more each time
        ("reason", "i4"),  # why it must not be sent; 0: it may
    ],
    align=True,
)


def wire_record(gate: GateConfig, driver: DriverConfig) -> Records:
    """(1,) of ``WIRE``."""
    record = np.zeros(1, WIRE)
    record["gate"][0] = gate.record
    sense = ProcessCodec(sense_id(driver.node_id, driver.sense_pdo), driver.protection)
    record["sense"][0] = sense_input.SenseInput(sense).record
    record["drive"][0] = process_pdo.pdo_record(int(gate.record["drive_id"][0]), driver.protection)
    record["flags"] = FD_FAST if driver.fd else 0
    record.setflags(write=False)
    return record


def new_wire_memory() -> Records:
    """(1,) of ``WIRE_MEMORY``: nothing has been sent or received."""
    memory = np.zeros(1, WIRE_MEMORY)
    begin(memory)
    return memory


@njit(cache=True, error_model="numpy")
def begin(memory: Records) -> None:
    """Nothing has been sent or received: what the combs hold is unknown, and the node may count from anywhere."""
    gate_rules.forget(memory[0]["gate"])
    sense_input.reset(memory[0]["sense"])


@njit(cache=True, error_model="numpy")
def judge(wire: Records, memory: Records, frame: Records) -> None:
    """Leave in ``frame["reason"]`` why it must not be sent, 0 if it may; then it counts as sent."""
    f = frame[0]
    f["reason"] = gate_rules.check(
        wire[0]["gate"], memory[0]["gate"], f["can_id"], f["flags"], f["length"], f["data"], f["mode"], f["t_us"]
    )


@njit(cache=True, error_model="numpy")
def clear(memory: Records) -> None:
    """After a fault was cleared: let the mode's frames pass again."""
    gate_rules.clear(memory[0]["gate"])


@njit(cache=True, error_model="numpy")
def sync(wire: Records, memory: Records) -> None:
    """A SYNC goes out: what was sensed before is old from now on."""
    sense_input.on_sync(wire[0]["sense"], memory[0]["sense"])


@njit(cache=True, error_model="numpy")
def receive(wire: Records, memory: Records, frame: Records) -> None:
    """A frame from the bus; anything but the sense frame is passed over."""
    f = frame[0]
    if f["can_id"] == wire[0]["sense"][0]["pdo"][0]["cob_id"]:
        sense_input.receive(wire[0]["sense"], memory[0]["sense"], f["length"], f["data"])


@njit(cache=True, error_model="numpy")
def take(memory: Records, cycle_memory: Records) -> None:
    """Hand counts and status of this period to the cycle's input."""
    sense, seen = memory[0]["sense"], cycle_memory[0]["input"]
    seen["sense_status"] = sense_input.take(sense)
    for i in range(3):
        seen["sense_count"][i] = sense[0]["count"][i]


@njit(cache=True, error_model="numpy")
def drive(wire: Records, cycle_memory: Records, frame: Records) -> None:
    """Make the drive frame of the cycle's counts, with the frame's counter; it has to be judged like any other."""
    f, count, pdo = frame[0], cycle_memory[0]["row"]["drive_count"], wire[0]["drive"]
    f["can_id"] = pdo[0]["cob_id"]
    f["flags"] = wire[0]["flags"]
    f["length"] = pdo[0]["length"]
    f["mode"] = cycle_memory[0]["mode"]
    f["data"] = process_pdo.encode(pdo, count[0], count[1], count[2], f["counter"])
