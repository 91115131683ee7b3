"""Identity, object dictionary and SDO: checks of what the node says about itself, in pre-operational."""

from collections.abc import Callable, Iterable, Iterator

from hil.conformance.deviation import DeviationError, NotTestedError, deviate_if
from hil.conformance.eds import Variable
from hil.conformance.sdo_client import SdoResult, upload_request
from hil.conformance.talker import Talker
from hil.conformance.verdict import OUR_CONTRACT, Check
from pkxyz_ctrl.can.sdo import NO_SUCH_OBJECT, abort_text
from pkxyz_ctrl.can.startup import identity_steps, plan, survey

_ABSENT_INDEX = 0x5FFF  # last of the manufacturer's area
_NO_OBJECT, _NO_SUBINDEX = 0x06020000, 0x06090011
_UNSUPPORTED, _READ_ONLY = 0x06010000, 0x06010002
_LENGTH, _TOO_LONG, _TOO_SHORT = 0x06070010, 0x06070012, 0x06070013
_NO_ERROR_YET = (0x08000024, 0x08000000)  # CiA 301, 7.5.2, object 1003h
_RANGES = (0x06090030, 0x06090031, 0x06090032)
_TOGGLE, _COMMAND = 0x05030000, 0x05040001
_IN_USE = (0x08000022, 0x08000021, 0x08000020, 0x08000000, 0x06010000, 0x06010002, 0x06090030)
# Values that follow the process or the single device, and are no defaults: error register and history, versions,
# serial number, inputs and outputs, protection. Identity and signature have lines of their own.
_OWN_VALUES = (0x1000, 0x1001, 0x1003, 0x1009, 0x100A, 0x1018, 0x2000, 0x2001, 0x2020, 0x6401, 0x6411)


def _answers(talker: Talker) -> str:
    talker.reset()
    result = talker.read(0x1000, 0)
    if not result.ok:
        raise DeviationError(f"0x1000:00: {result.text}")
    return f"0x1000:00 reads {result.text}"


def _identity(talker: Talker) -> str:
    talker.reset()
    deviations, told = [], []
    for step in identity_steps(talker.driver):
        result = talker.read(step.index, step.subindex)
        told.append(f"{step.what} 0x{result.unsigned:08X}" if result.ok else f"{step.what}: {result.text}")
        is_other = step.value is not None and result.ok and (result.unsigned ^ step.value) & ~step.alike
        if not result.ok or is_other:
            deviations.append(f"{step.name}: {told[-1]}, expected 0x{step.value or 0:08X}")
    deviate_if(deviations)
    return ", ".join(told)


def _objects_read(talker: Talker) -> str:
    talker.reset()
    readable = [variable for variable in talker.variables if variable.readable]
    outcomes = ((variable, talker.read(variable.index, variable.subindex)) for variable in readable)
    deviate_if([f"{variable.label}: {result.text}" for variable, result in outcomes if not _is_there(variable, result)])
    return f"all {len(readable)} read"


def _is_there(variable: Variable, result: SdoResult) -> bool:
    """An error that has not happened is no data, and a file is long: such an object exists all the same."""
    is_no_error = variable.index == 0x1003 and variable.subindex > 0 and result.abort in _NO_ERROR_YET
    return result.ok or result.is_cut or is_no_error


def _read_values(talker: Talker) -> Iterator[tuple[Variable, bytes]]:
    """What can be read; what cannot has a line of its own."""
    talker.reset()
    for variable in talker.variables:
        if variable.readable and (result := talker.read(variable.index, variable.subindex)).data is not None:
            yield variable, result.data


def _lengths(talker: Talker) -> str:
    fixed = [(variable, data) for variable, data in _read_values(talker) if variable.length is not None]
    wrong = [(variable, len(data)) for variable, data in fixed if len(data) != variable.length]
    deviate_if([f"{variable.label}: {length} bytes, not {variable.length}" for variable, length in wrong])
    return f"{len(fixed)} objects as long as their types"


def _defaults(talker: Talker) -> str:
    compared, deviations = 0, []
    for variable, data in _read_values(talker):
        plain_mapping = not talker.driver.protection and variable.is_pdo_parameter
        if variable.default is None or variable.index in _OWN_VALUES or plain_mapping:
            continue
        compared += 1
        if data.rstrip(b"\0") != variable.default.rstrip(b"\0"):
            deviations.append(f"{variable.label} ({variable.name}): {data.hex(' ')}, EDS {variable.default.hex(' ')}")
    deviate_if(deviations)
    return f"{compared} values as the EDS says"


def identity_of(talker: Talker) -> tuple[int | None, ...]:
    """Vendor, product, revision and serial number (0x1018:1 to 4); None for what the node does not tell."""
    results = (talker.read(0x1018, part) for part in (1, 2, 3, 4))
    return tuple(result.unsigned if result.ok else None for result in results)


Write = tuple[str, Variable, bytes]
"""How it is called if it goes wrong, where to, and what."""


def _written(talker: Talker, writes: Iterable[Write], is_right: Callable[[SdoResult], bool], words: str) -> str:
    """Writes, one after another, each of which has to end rightly."""
    outcomes = [(label, talker.write_bytes(v.index, v.subindex, data)) for label, v, data in writes]
    deviate_if([f"{label}: {result.text}" for label, result in outcomes if not is_right(result)])
    return f"{len(outcomes)} {words}"


def _refused_with(*codes: int) -> Callable[[SdoResult], bool]:
    return lambda result: result.abort in codes


def _drives(talker: Talker, variable: Variable) -> bool:
    """Whether writing it may put a voltage on the combs that nobody has allowed."""
    return variable.index in (0x6411, 0x6444) and not talker.allow_voltage


def _read_only(talker: Talker) -> str:
    writes = [(variable.label, variable, data) for variable, data in _read_values(talker) if not variable.writable]
    return _written(talker, writes, _refused_with(_READ_ONLY, _UNSUPPORTED), "writes refused")


def _writable(talker: Talker) -> str:
    writes = [
        (variable.label, variable, data)
        for variable, data in _read_values(talker)
        if variable.writable and not variable.is_pdo_parameter and 1 <= len(data) <= 4
        if not (any(data) and _drives(talker, variable))
    ]
    return _written(talker, writes, lambda result: result.ok, "objects take the value that they have")


def _configuration(talker: Talker) -> str:
    """As the driver does it: what differs is written; what is not there may be done without, or not."""
    talker.reset()
    found: dict[tuple[int, int], int | None] = {}
    for step in survey(talker.driver):
        result = talker.read(step.index, step.subindex)
        if result.ok:
            found[step.index, step.subindex] = result.unsigned
        elif result.abort in NO_SUCH_OBJECT:
            found[step.index, step.subindex] = None
    planned = plan(talker.driver, 32767, found)
    if planned.refusal:
        raise DeviationError(planned.refusal)
    deviations = []
    for step in planned.steps:
        if step.write:
            result = talker.write(step.index, step.subindex, step.value or 0, step.size)
            if not result.ok and not step.optional:
                deviations.append(f"{step.name} = 0x{step.value or 0:X}: {result.text}")
        elif step.value is not None:
            result = talker.read(step.index, step.subindex)
            if not result.ok or (result.unsigned ^ step.value) & ~step.alike:
                deviations.append(f"{step.name}: {result.text}, not 0x{step.value or 0:X}")
    deviate_if(deviations)
    return "; ".join((f"{len(found)} values asked for, {len(planned.steps)} transfers", *planned.lost))


def _mapping_in_use(talker: Talker) -> str:
    talker.operational()
    deviations = []
    for index in (talker.drive_parameter + 0x200, talker.sense_parameter + 0x200):
        result = talker.write(index, 0, 0, 1)
        if result.abort not in _IN_USE:
            deviations.append(f"0x{index:04X}:00 = 0: {result.text}")
    deviate_if(deviations)
    return "both refused"


def _aborted(talker: Talker, request: bytes, *codes: int) -> str:
    """A request that has to be answered by one of these aborts."""
    reply = talker.exchange(request)
    if reply is None:
        raise DeviationError("no answer")
    code = int.from_bytes(reply[4:], "little")
    if reply[0] != 0x80 or code not in codes:
        raise DeviationError(f"abort {abort_text(code)}" if reply[0] == 0x80 else f"accepted: {reply.hex(' ')}")
    return f"abort {abort_text(code)}"


def _aborts(request: bytes, code: int) -> Callable[[Talker], str]:
    """A check: after reset, the request is answered by the abort."""

    def perform(talker: Talker) -> str:
        talker.reset()
        return _aborted(talker, request, code)

    return perform


def _refuses_lengths(change: int, *codes: int) -> Callable[[Talker], str]:
    """A check: so many bytes more or less than an object has are refused."""

    def perform(talker: Talker) -> str:
        talker.reset()
        writes = [
            (f"{variable.label} with {variable.length + change} bytes", variable, bytes(variable.length + change))
            for variable in talker.variables
            if variable.writable and not variable.is_pdo_parameter and variable.length
            if 1 <= variable.length + change <= 4
        ]
        return _written(talker, writes, _refused_with(*codes), "refused")

    return perform


def _out_of_range(talker: Talker) -> str:
    talker.reset()
    writes = [
        (f"{variable.label} = {value}", variable, variable.bytes_of(value))
        for variable in talker.variables
        if variable.writable and not variable.is_pdo_parameter and not _drives(talker, variable)
        for value in _just_beyond(variable)
    ]
    if not writes:
        raise NotTestedError("the EDS gives no limits within the types")
    deviations = []
    for label, variable, data in writes:
        before = talker.read(variable.index, variable.subindex)
        result = talker.write_bytes(variable.index, variable.subindex, data)
        if result.abort not in _RANGES:
            deviations.append(f"{label}: {result.text}")
        if result.ok and before.data is not None:  # no reset need forget it, and 0x6411 may go to the terminals
            talker.write_bytes(variable.index, variable.subindex, before.data)
    deviate_if(deviations)
    return f"{len(writes)} values refused"


def _just_beyond(variable: Variable) -> Iterator[int]:
    """One more and one less than an object may be, as far as its type has such values."""
    lowest, highest = variable.type_range
    if variable.high is not None and variable.high < highest:
        yield variable.high + 1
    if variable.low is not None and variable.low > lowest:
        yield variable.low - 1


def _toggle(talker: Talker) -> str:
    talker.reset()
    for variable in talker.variables:
        if variable.length is None and variable.readable:
            reply = talker.exchange(upload_request(variable.index, variable.subindex))
            if reply is not None and reply[0] & 0xE2 == 0x40:
                return _aborted(talker, bytes((0x70,)) + bytes(7), _TOGGLE)
    raise NotTestedError("no object is read in segments")


def _client_abort(talker: Talker) -> str:
    talker.reset()
    reply = talker.exchange(bytes.fromhex("80 00 10 00 00 00 04 05"))
    if reply is not None:
        raise DeviationError(f"answered with {reply.hex(' ')}")
    return "no answer"


_no_index = _aborts(upload_request(_ABSENT_INDEX, 0), _NO_OBJECT)
_no_subindex = _aborts(upload_request(0x1018, 0xF0), _NO_SUBINDEX)
_command = _aborts(b"\xe0" + bytes(7), _COMMAND)
_too_long = _refuses_lengths(1, _TOO_LONG, _LENGTH)
_too_short = _refuses_lengths(-1, _TOO_SHORT, _LENGTH)

_A, _B, _C = "identity", "object dictionary", "SDO"
_SDO, _OBJECTS = "CiA 301, 7.2.4 (SDO)", "CiA 301, 7.5.2 (objects)"
_EDS = "CiA 306: its own EDS"
ANSWERS = Check(_A, "answers", "0x1000 is read after NMT reset node", _SDO, _answers, False)
CHECKS = (
    Check(_A, "identity", "device type, vendor and product of the bus configuration", OUR_CONTRACT, _identity, False),
    Check(_B, "objects exist", "every readable object of the EDS is read", _EDS, _objects_read, False),
    Check(_B, "object lengths", "as many bytes as the type in the EDS has", _EDS, _lengths, False),
    Check(_B, "default values", "after reset, what the EDS gives as default", _EDS, _defaults, False),
    Check(_B, "read-only objects", "ro and const objects refuse a write with 0x06010002", _SDO, _read_only, False),
    Check(_B, "writable objects", "rw objects take the value that they have", _EDS, _writable, False),
    Check(
        _B,
        "configuration",
        "all that our driver writes at the start is accepted and read back",
        OUR_CONTRACT,
        _configuration,
        False,
    ),
    Check(_B, "mapping in use", "a PDO in use refuses another mapping", _OBJECTS, _mapping_in_use, False),
    Check(_C, "unknown index", "abort 0x06020000", _SDO, _no_index, False),
    Check(_C, "unknown sub-index", "abort 0x06090011", _SDO, _no_subindex, False),
    Check(_C, "too long", "a byte too many: abort 0x06070012 or 0x06070010", _SDO, _too_long, False),
    Check(_C, "too short", "a byte too few: abort 0x06070013 or 0x06070010", _SDO, _too_short, False),
    Check(_C, "out of range", "one beyond the EDS's limits: abort 0x06090030, 31 or 32", _SDO, _out_of_range, False),
    Check(_C, "toggle bit", "a segment with the wrong toggle bit: abort 0x05030000", _SDO, _toggle, False),
    Check(_C, "unknown command", "command specifier 7: abort 0x05040001", _SDO, _command, False),
    Check(_C, "client's abort", "not answered", _SDO, _client_abort, False),
)
