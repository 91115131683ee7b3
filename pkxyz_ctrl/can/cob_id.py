"""Identifiers and NMT numbers of CiA 301 that the amplifier's connection uses."""

from enum import IntEnum

NMT = 0x000
SYNC = 0x080
EMCY_BASE = 0x080  # plus node id
SENSE_BASE = 0x280  # TPDO2: analogue inputs (CiA 401)
OUTPUT_BASE = 0x200  # RPDO1: digital outputs (CiA 401)
DRIVE_BASE = 0x300  # RPDO2: analogue outputs (CiA 401)
PDO_STEP = 0x100  # from one PDO of the predefined connection set to the next
USUAL_PDO = 2
SIGNATURE_PDO = 3  # TPDO with the signature of the safety objects
SDO_RESPONSE_BASE = 0x580  # server to client
SDO_REQUEST_BASE = 0x600  # client to server
HEARTBEAT_BASE = 0x700

COB_ID_INVALID = 1 << 31  # bit 31 of a PDO's COB-ID entry: the PDO does not exist
COB_ID_NO_RTR = 1 << 30  # bit 30 of a TPDO's COB-ID entry: not available by remote frame

SYNC_COUNTER_OVERFLOW = 240  # 0x1019: the largest value that CiA 301 permits; the counter runs 1..240
SYNCHRONOUS_EVERY_SYNC = 1  # transmission type


class NmtCommand(IntEnum):
    """Command specifiers of the NMT service (CiA 301, 7.2.8.2)."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """States that a heartbeat carries; ``BOOT_UP`` is the boot-up message."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def drive(node_id: int, pdo: int) -> int:
    """Identifier of RPDO ``pdo``, 1 to 4, in the predefined connection set (CiA 301, 7.3.5)."""
    return DRIVE_BASE + (pdo - USUAL_PDO) * PDO_STEP + node_id


def sense(node_id: int, pdo: int) -> int:
    """Identifier of TPDO ``pdo``, 1 to 4."""
    return SENSE_BASE + (pdo - USUAL_PDO) * PDO_STEP + node_id


def state_name(node_state: int) -> str:
    """``pre-operational``: what a heartbeat's number means."""
    try:
        return NmtState(node_state).name.lower().replace("_", "-")
    except ValueError:
        return f"unknown state 0x{node_state:02X}"
