"""What nothing depends on: digital outputs for triggers, the signature of the safety objects. A node may lack both."""

from hil.conformance.deviation import DeviationError, NotTestedError
from hil.conformance.talker import SETTLE_US, Talker
from hil.conformance.verdict import OUR_CONTRACT, Check
from pkxyz_ctrl.can.sdo import NO_SUCH_OBJECT
from pkxyz_ctrl.can.startup import plan, table

_PATTERNS = (0x15, 0x0A, 0x00)
_OUTPUT, _SIGNATURE = 0x6200, 0x2020
_ROOM = "triggers are recorded, and not put out"


def _digital_outputs(talker: Talker) -> str:
    if talker.driver.output_id < 0:
        raise NotTestedError(f"not wanted by the bus config: {_ROOM}")
    if talker.read(_OUTPUT, 1).abort in NO_SUCH_OBJECT:
        raise NotTestedError(f"the node has no 0x6200:01: {_ROOM}")
    talker.operational()
    for bits in _PATTERNS:
        talker.cycles(1)
        talker.send(talker.driver.output_id, bytes((bits,)))
        talker.cycles(2)
        told = talker.read(_OUTPUT, 1)
        if not told.ok or told.unsigned != bits:
            raise DeviationError(f"0x6200:01 after 0x{bits:02X} in RPDO 1 and a SYNC: {told.text}")
    return f"{len(_PATTERNS)} patterns are put out"


def _signature(talker: Talker) -> str:
    if talker.driver.signature_id < 0:
        raise NotTestedError("not wanted by the bus config")
    if talker.read(_SIGNATURE, 1).abort in NO_SUCH_OBJECT:
        raise NotTestedError("the node has no 0x2020:01: a change of its safety objects at work is not seen")
    talker.operational()
    talker.run(SETTLE_US)
    found: dict[tuple[int, int], int | None] = {}
    for setting in table(talker.driver):
        told = talker.read(setting.index, setting.subindex)
        if told.ok:
            found[setting.key] = told.unsigned
    if any("no signature" in words for words in plan(talker.driver, 32767, found).lost):
        raise DeviationError(
            f"0x2020:01 is 0x{found.get((_SIGNATURE, 1), 0):04X}: not the CRC of what its objects read"
        )
    return "the CRC of what its objects read"


CHECKS = (
    Check(
        "digital outputs", "RPDO 1", "0x6200:01 takes its byte at the SYNC", "CiA 401, object 6200h", _digital_outputs
    ),
    Check("signature", "of what is read", "0x2020:01 is the CRC-16 of the safety objects", OUR_CONTRACT, _signature),
)
