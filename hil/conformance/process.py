"""SYNC, sense PDO and drive PDO: checks of the process data, with 0 counts only unless voltage is allowed."""

from collections.abc import Iterator
from itertools import pairwise
from statistics import median

from hil.conformance.deviation import DeviationError, NotTestedError, deviate_if, first_few
from hil.conformance.talker import SETTLE_US, ZERO, Talker
from hil.conformance.verdict import OUR_CONTRACT, Check
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.cob_id import NmtCommand
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.can.emergency import code_text
from pkxyz_ctrl.can.sdo import NO_SUCH_OBJECT

TEST_COUNTS: Counts = (164, 328, 492)  # 1, 2 and 3 V on a range of 200 V: seen by a voltmeter, felt by no comb
_WARM_UP = 10
_ANSWER_US = 100_000  # for a sense PDO, before it is called missing
_ERROR_END_US = 400_000  # a node may hold an error for a while, so that a flickering one makes no flood


def _sense_frames(talker: Talker) -> list[bytes]:
    """The sense PDOs after so many SYNCs at rate; when each came is the affair of the line on latency."""
    talker.operational()
    talker.cycles(_WARM_UP)
    talker.run(SETTLE_US)
    mark = talker.mark()
    talker.cycles(talker.sample_cycles)
    talker.run(SETTLE_US)
    return [data for _, data in talker.since(mark, talker.sense_id)]


def _sense_per_sync(talker: Talker) -> str:
    length = talker.sense_codec.length
    frames = _sense_frames(talker)
    wrong = sum(len(data) != length for data in frames)
    told = f"{talker.sample_cycles} SYNCs: {len(frames)} sense PDOs, {wrong} of them not {length} bytes long"
    if wrong or len(frames) != talker.sample_cycles:
        raise DeviationError(told)
    return told


def _latency(talker: Talker) -> str:
    """Each SYNC waits for its own answer: one that comes after the next SYNC must not pass for that one's."""
    talker.operational()
    talker.cycles(_WARM_UP)
    talker.run(_ANSWER_US)  # until no answer of those is on its way any more
    delays_us = []
    for _ in range(talker.sample_cycles):
        delay_us = _answer_us(talker)
        if delay_us is not None:
            delays_us.append(delay_us)
        elif not delays_us:
            raise DeviationError(f"no sense PDO within {_ANSWER_US // 1000} ms of the SYNC")
    delays_us.sort()
    told = (
        f"{len(delays_us)} PDOs: minimum {delays_us[0]}, median {median(delays_us):g}, "
        f"p99 {delays_us[int(0.99 * (len(delays_us) - 1))]}, maximum {delays_us[-1]} us after SYNC was handed over, "
        f"{talker.sample_cycles - len(delays_us)} SYNCs without; "
        f"limit {talker.can.sense_deadline_us} us"
    )
    if delays_us[-1] > talker.can.sense_deadline_us:
        raise DeviationError(told)
    return told


def _answer_us(talker: Talker) -> int | None:
    """One cycle that waits for its sense PDO, however late; None if none came in a time in which none is of any use."""
    talker.run(0)  # nothing of before is left to be taken for an answer
    begin_us = talker.sync()
    delay_us = None
    while delay_us is None and (left_us := begin_us + _ANSWER_US - talker.now_us) > 0:
        answer = talker.first(talker.sense_id, left_us)
        if answer is not None and answer[0] >= begin_us:
            delay_us = answer[0] - begin_us
    talker.send(talker.drive_id, talker.next_drive())
    talker.run(max(0, begin_us + talker.bus.period_us - talker.now_us))
    return delay_us


def _protected_sense(talker: Talker) -> list[bytes]:
    if not talker.driver.protection:
        raise NotTestedError("the bus configuration says protection = false")
    frames = [data for data in _sense_frames(talker) if len(data) == 8]
    if len(frames) < 2:
        raise NotTestedError("no sense PDOs of 8 bytes")
    return frames


def _sense_counter(talker: Talker) -> str:
    counters = [data[6] for data in _protected_sense(talker)]
    breaks = [f"{a} then {b}" for a, b in pairwise(counters) if b != (a + 1) & 0xFF]
    deviate_if(breaks)
    return f"{len(counters)} in sequence"


def _sense_crc(talker: Talker) -> str:
    frames = _protected_sense(talker)
    deviate_if([data.hex(" ") for data in frames if not talker.sense_codec.decode(data)[4]])
    return f"{len(frames)} right"


def _sync_data(talker: Talker, wrong: tuple[bytes, ...]) -> str:
    """A SYNC that cannot be one: no sense PDO; EMCY 0x8240."""
    deviations = []
    for data in wrong:
        talker.operational()
        if not talker.sync_overflow:
            raise NotTestedError("the node counts no SYNCs (0x1019)")
        talker.cycles(_WARM_UP)
        talker.run(SETTLE_US)  # a sense PDO that is late must not count as an answer
        mark = talker.mark()
        talker.sync(data)
        talker.run(talker.bus.period_us + SETTLE_US)
        name = f"SYNC with {data.hex(' ') or 'no data'}"
        if talker.since(mark, talker.sense_id):
            deviations.append(f"{name}: taken for a SYNC")
        elif 0x8240 not in talker.emergencies(mark):
            deviations.append(f"{name}: no EMCY 0x8240")
    deviate_if(deviations)
    return f"{len(wrong)} refused"


def _sync_length(talker: Talker) -> str:
    return _sync_data(talker, (b"", b"\1\1"))


def _sync_counter(talker: Talker) -> str:
    return _sync_data(talker, (b"\0", b"\xf1", b"\xff"))


def _every_third(talker: Talker) -> str:
    talker.operational()
    on, off = talker.sense_id | cob_id.COB_ID_NO_RTR, talker.sense_id | cob_id.COB_ID_NO_RTR | cob_id.COB_ID_INVALID
    talker.nmt(NmtCommand.PRE_OPERATIONAL)  # a node may hold its PDOs fixed while operational
    parameter = talker.sense_parameter
    talker.write(parameter, 1, off, 4)
    written = talker.write(parameter, 2, 3, 1)
    talker.write(parameter, 1, on, 4)
    talker.nmt(NmtCommand.START)
    if not written.ok:
        raise DeviationError(f"0x{parameter:04X}:02 = 3: {written.text}")
    mark = talker.mark()
    talker.cycles(30)
    talker.run(2000)
    count = len(talker.since(mark, talker.sense_id))
    if count != 10:
        raise DeviationError(f"{count} sense PDOs for 30 SYNCs")
    return "10 sense PDOs for 30 SYNCs"


def _switched_off(talker: Talker) -> str:
    talker.operational()
    talker.nmt(NmtCommand.PRE_OPERATIONAL)
    talker.write(talker.sense_parameter, 1, talker.sense_id | cob_id.COB_ID_NO_RTR | cob_id.COB_ID_INVALID, 4)
    talker.nmt(NmtCommand.START)
    mark = talker.mark()
    talker.cycles(10)
    talker.run(2000)
    if frames := talker.since(mark, talker.sense_id):
        raise DeviationError(f"{len(frames)} sense PDOs all the same")
    return "none in 10 SYNCs"


def _accepted(talker: Talker) -> str:
    talker.operational()
    counts = TEST_COUNTS if talker.allow_voltage else ZERO
    mark = talker.mark()
    talker.cycles(talker.sample_cycles, counts)
    talker.run(SETTLE_US)
    outputs, codes = talker.outputs(), [code for code in talker.emergencies(mark) if code]
    if codes or outputs != counts:
        raise DeviationError(f"0x6411 {outputs}, sent {counts}; EMCY {_told(codes)}")
    return f"{talker.sample_cycles} drive PDOs {counts}: 0x6411 reads the same, no EMCY"


def _refused(
    talker: Talker, code: int, frames: Iterator[tuple[str, bytes]], *, must_not_apply: bool = True, or_code: int = 0
) -> str:
    """Each of ``frames`` once in place of a good one: EMCY ``code`` (or ``or_code``); with voltage, outputs kept."""
    base = TEST_COUNTS if talker.allow_voltage else ZERO
    count, is_applied, deviations = 0, False, []
    for name, data in frames:
        count += 1
        if (outputs := talker.outputs()) != base:  # a frame that is applied would not show
            raise NotTestedError(f"0x6411 reads {outputs} after {base} was sent")
        mark = talker.mark()
        talker.cycle(data)
        talker.cycle()
        talker.run(SETTLE_US)
        outputs, codes = talker.outputs(), talker.emergencies(mark)
        if outputs != base:
            is_applied = True
            deviations.append(f"{name}: applied, 0x6411 {outputs}")
        elif code not in codes and or_code not in (code for code in codes if code):
            deviations.append(f"{name}: no EMCY 0x{code:04X} ({code_text(code)}), but {_told(codes)}")
    if deviations:
        raise DeviationError(first_few(deviations), is_unsafe=is_applied and must_not_apply)
    return f"{count} refused with EMCY 0x{code:04X}" + (", outputs as before" if any(base) else "")


def _anew(talker: Talker) -> Counts:
    """Operational with good drive PDOs; what a bad one may carry: other counts only if voltage is allowed."""
    talker.operational()
    if not talker.allow_voltage:
        talker.cycles(_WARM_UP)
        return ZERO
    talker.cycles(_WARM_UP, TEST_COUNTS)
    return TEST_COUNTS[1], TEST_COUNTS[2], TEST_COUNTS[0]


def _require_protection(talker: Talker) -> None:
    if not talker.driver.protection:
        raise NotTestedError("the bus configuration says protection = false")


def _wrong_crc(talker: Talker) -> str:
    _require_protection(talker)

    def frames() -> Iterator[tuple[str, bytes]]:
        for bit in range(56, 64):
            good = int.from_bytes(talker.drive_codec.encode(_anew(talker), talker.drive_counter + 1 & 0xFF), "little")
            yield f"bit {bit} wrong", (good ^ 1 << bit).to_bytes(8, "little")

    return _refused(talker, 0xFF10, frames())


def _wrong_counter(talker: Talker) -> str:
    _require_protection(talker)

    def frames() -> Iterator[tuple[str, bytes]]:
        for step in (0, 2, 255):
            counts = _anew(talker)
            yield f"alive counter {step:+d}", talker.drive_codec.encode(counts, talker.drive_counter + step & 0xFF)

    return _refused(talker, 0xFF11, frames())


def _late(talker: Talker) -> str:
    _require_protection(talker)

    def frames() -> Iterator[tuple[str, bytes]]:
        for syncs in (1, 2):
            counts = _anew(talker)
            for _ in range(syncs):  # the first applies what came before it, the others find nothing
                talker.cycle()
            late = talker.drive_codec.encode(counts, talker.drive_counter + 1 & 0xFF)
            yield f"the next counter, {syncs} SYNCs too late", late

    return _refused(talker, 0xFF13, frames())


def _too_short(talker: Talker) -> str:
    def frames() -> Iterator[tuple[str, bytes]]:
        for length in (0, 2, talker.drive_codec.length - 1):
            counts = _anew(talker)
            good = talker.drive_codec.encode(counts, talker.drive_counter + 1 & 0xFF)
            yield f"{length} bytes", good[:length]

    return _refused(talker, 0x8210, frames())


def _too_long(talker: Talker) -> str:
    if talker.driver.protection and not talker.driver.fd:
        raise NotTestedError("a classic frame cannot be longer")
    length = 12 if talker.driver.protection else 8

    def frames() -> Iterator[tuple[str, bytes]]:
        counts = _anew(talker)
        good = talker.drive_codec.encode(counts, talker.drive_counter + 1 & 0xFF)
        yield f"{length} bytes", good.ljust(length, b"\0")

    # CiA 301 lets a node take the front of it (0x8220), or not process it at all (0x8210)
    return _refused(talker, 0x8220, frames(), must_not_apply=False, or_code=0x8210)


def _negative(talker: Talker) -> str:
    if not talker.allow_voltage:
        raise NotTestedError("a node that applies it may drive full voltage: only with --allow-voltage")

    def frames() -> Iterator[tuple[str, bytes]]:
        for comb in range(3):
            _anew(talker)
            a, b, c = (-1 if place == comb else count for place, count in enumerate(TEST_COUNTS))
            yield f"-1 at comb {comb + 1}", talker.drive_codec.encode((a, b, c), talker.drive_counter + 1 & 0xFF)

    # CiA 401 has negative counts; that 0x6411 holds one says nothing of the terminals
    return _refused(talker, 0xFF12, frames(), must_not_apply=talker.driver.protection)


def _emergency_ends(talker: Talker) -> str:
    """Register and history while an error is there, and that its end is told."""
    talker.operational()
    talker.cycles(_WARM_UP)
    mark = talker.mark()
    talker.cycle(talker.next_drive()[:-1])
    talker.cycle()  # where it would have been applied
    talker.run(SETTLE_US)
    codes = talker.emergencies(mark)
    if not codes:
        raise NotTestedError("no EMCY came after a drive PDO that was too short")
    register, field = talker.read(0x1001, 0), talker.read(0x1003, 1)
    deviations = []
    if register.unsigned < 0 or not register.unsigned & 1:
        deviations.append(f"0x1001:00 with the error: {register.text}")
    if field.abort not in NO_SUCH_OBJECT and field.unsigned & 0xFFFF != codes[0]:  # 0x1003 is optional
        deviations.append(f"0x1003:01: {field.text}, EMCY {_told(codes[:1])}")
    mark = talker.mark()
    talker.cycles(_ERROR_END_US // talker.bus.period_us)
    if 0 not in talker.emergencies(mark):
        deviations.append(f"no EMCY 0x0000 within {_ERROR_END_US // 1000} ms of good frames")
    elif (after := talker.read(0x1001, 0)).unsigned != 0:
        deviations.append(f"0x1001:00 after the error: {after.text}")
    deviate_if(deviations)
    return f"EMCY {_told(codes)}, register {register.text}, history {field.text}, and its end was told"


def _told(codes: list[int]) -> str:
    return ", ".join(f"0x{code:04X}" for code in codes) or "none"


_A, _B, _C, _D = "SYNC", "sense PDO", "drive PDO", "EMCY"
_PDO, _SYNC, _EMCY = "CiA 301, 7.2.2 (PDO)", "CiA 301, 7.2.5 (SYNC)", "CiA 301, 7.2.7 (EMCY)"
CHECKS = (
    Check(
        _B, "one per SYNC", "every SYNC at rate is followed by one sense PDO of the right length", _PDO, _sense_per_sync
    ),
    Check(_B, "latency", "no later than sense_deadline_us of the bus configuration", OUR_CONTRACT, _latency),
    Check(_B, "alive counter", "one more in every sense PDO, modulo 256", OUR_CONTRACT, _sense_counter),
    Check(_B, "CRC", "CRC8H2F over COB-ID and bytes 0 to 6", OUR_CONTRACT, _sense_crc),
    Check(_B, "transmission type", "type 3: one in three SYNCs", _PDO, _every_third),
    Check(_B, "switched off", "none while bit 31 of its COB-ID is set", _PDO, _switched_off),
    Check(_A, "SYNC length", "0 or 2 bytes are no SYNC: no sense PDO, EMCY 0x8240", _SYNC, _sync_length),
    Check(_A, "SYNC counter", "0 and 241 to 255 are no SYNC: no sense PDO, EMCY 0x8240", OUR_CONTRACT, _sync_counter),
    Check(_C, "accepted", "valid drive PDOs are applied, 0x6411 reads back, no EMCY", OUR_CONTRACT, _accepted),
    Check(_C, "wrong CRC", "refused with EMCY 0xFF10", OUR_CONTRACT, _wrong_crc),
    Check(
        _C, "wrong alive counter", "repeated, skipped or old: refused with EMCY 0xFF11", OUR_CONTRACT, _wrong_counter
    ),
    Check(_C, "late", "the next one after a SYNC that found none: refused with EMCY 0xFF13", OUR_CONTRACT, _late),
    Check(_C, "too short", "refused with EMCY 0x8210", _PDO, _too_short),
    Check(
        _C,
        "too long",
        "refused with EMCY 0x8220 or 0x8210; CiA 301 lets a node take the front of it",
        OUR_CONTRACT,
        _too_long,
    ),
    Check(_C, "negative count", "refused with EMCY 0xFF12", OUR_CONTRACT, _negative),
    Check(_D, "register and end", "0x1001 and 0x1003 tell the error, EMCY 0x0000 its end", _EMCY, _emergency_ends),
)
