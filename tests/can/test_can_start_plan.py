"""What the start-up writes and what a node may lack, from what was found: each condition of the plan met alone."""

import struct
from binascii import crc_hqx

import numpy as np
import pytest

from pkxyz_ctrl.can import start_plan
from pkxyz_ctrl.can.driver_config import DriverConfig, ProvenModule
from pkxyz_ctrl.can.startup import (
    DRIVE_TIMEOUT,
    HEARTBEAT_LOST,
    LEAVING,
    Plan,
    identity_steps,
    plan,
    settings,
    survey,
    table,
)

HELD: dict[tuple[int, int], int | None] = {(0x1018, 3): 0x10000, (0x1018, 4): 1} | {
    setting.key: setting.value for setting in table(DriverConfig()) if setting.value is not None
}
"""What a node holds of which nothing has to be written."""


ALL: dict[str, object] = {"digital_outputs": True, "signature_syncs": 240}


def report(*lines: str, serial: int = 1) -> ProvenModule:
    return ProvenModule(
        vendor_id=0x7078797A, product_code=3, revision=0x10000, serial=serial, lines=lines, digest="sha256:" + 64 * "0"
    )


def planned(found: dict[tuple[int, int], int | None], **config: object) -> Plan:
    return plan(DriverConfig(**config), 32767, found)


def written(found: dict[tuple[int, int], int | None], **config: object) -> list[tuple[int, int, int | None]]:
    return [(step.index, step.subindex, step.value) for step in planned(found, **config).steps if step.write]


# -- what is written -------------------------------------------------------------------------------------------------


def test_a_node_that_holds_everything_is_written_nothing_and_read_all_the_same() -> None:
    assert written(HELD) == []
    assert len(planned(HELD).steps) == len(settings(DriverConfig())) == len(HELD) - 5


def test_a_pdo_is_taken_out_of_use_for_what_differs_and_for_nothing_else() -> None:
    """COB-ID, kind, an entry, and their number: each alone."""
    off, on = (0x1401, 1, 0x8000030A), (0x1401, 1, 0x30A)
    entries = [(0x1601, place, HELD[0x1601, place]) for place in range(1, 6)]
    anew = [(0x1601, 0, 0), *entries, (0x1601, 0, 5)]
    assert written(HELD | {(0x1401, 1): 0x30B}) == [off, on]
    assert written(HELD | {(0x1401, 2): 255}) == [(0x1401, 2, 1)]
    for place in (1, 3, 5):
        assert written(HELD | {(0x1601, place): 0x64110410}) == [off, *anew, on]
    assert written(HELD | {(0x1601, 0): 4}) == [off, *anew, on]
    assert written(HELD | {(0x1601, 0): 0}) == [off, *anew, on], "0 is a value that was found"


def test_bits_in_which_an_object_may_differ_do_not_count() -> None:
    assert written(HELD | {(0x1401, 1): 0x4000030A}) == []
    assert written(HELD | {(0x1029, 1): 2}) == []
    assert written(HELD | {(0x1029, 1): 1}) == [(0x1029, 1, 0)]


def test_the_survey_asks_for_everything_but_what_the_identity_has_told() -> None:
    asked = [(step.index, step.subindex) for step in survey(DriverConfig())]
    assert asked == [setting.key for setting in table(DriverConfig())[3:]]


def test_what_is_not_there_is_neither_written_nor_read() -> None:
    """Not a part of it either, where another part is missing."""
    proven = report(HEARTBEAT_LOST, LEAVING, DRIVE_TIMEOUT)
    for index, subindex in ((0x1019, 0), (0x1016, 1), (0x6443, 2)):
        steps = planned(HELD | {(0x6444, 1): 5, (index, subindex): None}, proven=proven).steps
        assert (0x6444, 1, True) in [(step.index, step.subindex, step.write) for step in steps]
        assert index not in {step.index for step in steps}


def test_identity_is_compared_in_every_bit_and_what_is_surveyed_in_none() -> None:
    """But whether a module also has digital outputs, bit 17 of its device type."""
    assert [(step.optional, step.alike) for step in identity_steps(DriverConfig())] == [
        (False, 1 << 17), (False, 0), (False, 0),
    ]  # fmt: skip
    assert {(step.optional, step.alike) for step in survey(DriverConfig())} == {(True, 0)}


# -- what may be lacking ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "protection", "refused"),
    [
        ((), True, True),
        ((HEARTBEAT_LOST,), True, True),
        ((DRIVE_TIMEOUT,), True, False),
        ((DRIVE_TIMEOUT,), False, True),
    ],
)
def test_without_a_consumer_only_a_proven_drive_time_out_helps(
    lines: tuple[str, ...], protection: bool, refused: bool
) -> None:
    found = planned(HELD | {(0x1016, 1): None}, protection=protection, proven=report(*lines))
    assert ("no 0x1016" in found.refusal) == refused
    assert found.is_proven == bool(lines)
    assert refused or "its drive time-out (0x2012) takes over" in found.lost[-1]


@pytest.mark.parametrize(
    ("lines", "serial", "refused"),
    [((HEARTBEAT_LOST, LEAVING), 1, False), ((LEAVING,), 1, True), ((HEARTBEAT_LOST, LEAVING), 2, True)],
)
def test_without_error_values_only_a_report_on_this_module_helps(
    lines: tuple[str, ...], serial: int, refused: bool
) -> None:
    found = planned(HELD | {(0x6444, 2): None}, proven=report(*lines, serial=serial))
    assert ("no 0x6444" in found.refusal) == refused
    assert any("it is of another module" in words for words in found.lost) == (serial != 1)


def test_of_what_is_lacking_the_first_is_named() -> None:
    """By index, then by part: a COB-ID as well."""
    assert planned(HELD | {(0x6443, 2): None, (0x6443, 1): None}).refusal.startswith("no 0x6443 (error mode of comb 1")
    assert planned(HELD | {(0x1401, 1): None}).refusal.startswith("no 0x1401 (COB-ID of the drive PDO)")


def test_a_report_that_shows_nothing_does_not_count() -> None:
    assert "it is of another module" in planned(HELD, proven=report()).lost[0]
    assert planned(HELD).lost == ()


def test_what_can_be_done_without_is_told_up_to_what_can_not() -> None:
    """By index: what lies behind the first that is refused nobody wants to know."""
    lacking = HELD | {(0x1019, 0): None, (0x1029, 1): None}
    assert [words[:9] for words in planned(lacking).lost] == ["no 0x1019", "no 0x1029"]
    refused = planned(lacking | {(0x1017, 0): None, (0x2011, 0): None, (0x6443, 1): None})
    assert refused.refusal.startswith("no 0x1017")
    assert refused.lost == ()
    assert [words[:9] for words in planned(lacking | {(0x2011, 0): None}).lost] == ["no 0x1019", "no 0x1029"]


def test_sync_has_its_identifier_where_the_node_does_not_tell_it() -> None:
    found = planned(HELD | {(0x1005, 0): None})
    assert (found.refusal, found.lost) == ("", ())


def test_what_has_no_room_among_the_steps_is_left_out_and_does_no_harm() -> None:
    """A node of which nothing is known takes all that there are, and every row."""
    memory = np.zeros(1, start_plan.START_MEMORY)
    for row in range(start_plan.STEPS_MOST + 2):
        start_plan._add(memory[0], row % start_plan.ROWS_MOST, start_plan.ASK)
    assert memory["steps"][0] == start_plan.STEPS_MOST
    steps = planned({}, **ALL).steps
    assert len(steps) == start_plan.STEPS_MOST
    assert len(table(DriverConfig(**ALL))) == start_plan.ROWS_MOST
    assert (steps[-2].index, steps[-2].write) == (0x1019, False), "the last but one is the last read-back, not a write"
    assert (steps[-1].index, steps[-1].write) == (0x2020, False), "then what the node signs of it"


# -- what a node may do beside its combs -------------------------------------------------------------------------------

OUTPUTS_LOST = "no digital outputs (0x6200:1) in RPDO 1"
SIGNATURE_LOST = "no signature of its safety objects (0x2020) in TPDO 3"


def whole(**config: object) -> dict[tuple[int, int], int | None]:
    """What a node holds of which nothing has to be written, with outputs 0 and the right signature."""
    held = HELD | {s.key: s.value for s in table(DriverConfig(**config)) if s.value is not None} | {(0x6200, 1): 0}
    return held | {(0x2020, 1): signed(held)}


def signed(held: dict[tuple[int, int], int | None]) -> int:
    """CRC-16-CCITT from 0xFFFF by Python's own function, over what keeps the combs safe, in its order."""
    keys = [s for s in table(DriverConfig()) if s.part >= start_plan.COB_ID and held.get(s.key) is not None]
    data = b"".join(
        struct.pack("<HB", *s.key) + (held[s.key] or 0).to_bytes(s.size, "little")
        for s in sorted(keys, key=lambda s: s.key)
    )
    return crc_hqx(data, 0xFFFF)


def test_outputs_and_signature_that_stand_are_left_alone() -> None:
    assert written(whole(**ALL), **ALL) == []
    assert planned(whole(**ALL), **ALL).lost == ()


@pytest.mark.parametrize("lacking", [(0x6200, 1), (0x1400, 1), (0x1600, 0)])
def test_a_node_without_outputs_is_told_and_not_refused(lacking: tuple[int, int]) -> None:
    plan = planned(whole(**ALL) | {lacking: None, (0x1600, 1): 5}, **ALL)
    assert plan.refusal == ""
    assert [words[: len(OUTPUTS_LOST)] for words in plan.lost] == [OUTPUTS_LOST]
    assert not [step for step in plan.steps if step.write], "its RPDO 1 may be for something else"
    assert lacking[0] not in {step.index for step in plan.steps}
    drive = written(whole(**ALL) | {lacking: None, (0x1401, 1): 0x30B}, **ALL)
    assert drive == [(0x1401, 1, 0x8000030A), (0x1401, 1, 0x30A)], "its combs are driven all the same"


@pytest.mark.parametrize("lacking", [(0x2020, 1), (0x1802, 1), (0x1A02, 0)])
def test_a_node_without_signature_is_told_and_not_refused(lacking: tuple[int, int]) -> None:
    plan = planned(whole(**ALL) | {lacking: None}, **ALL)
    assert (plan.refusal, [words[: len(SIGNATURE_LOST)] for words in plan.lost]) == ("", [SIGNATURE_LOST])


def test_another_signature_is_not_relied_on() -> None:
    held = whole(**ALL)
    plan = planned(held | {(0x2020, 1): held[0x2020, 1] ^ 1}, **ALL)
    assert [words[: len(SIGNATURE_LOST)] for words in plan.lost] == [SIGNATURE_LOST]


def test_what_a_node_lacks_is_not_signed() -> None:
    held = whole(**ALL) | {(0x1019, 0): None}
    assert not [words for words in planned(held | {(0x2020, 1): signed(held)}, **ALL).lost if SIGNATURE_LOST in words]
    assert [words for words in planned(held, **ALL).lost if SIGNATURE_LOST in words], "of all of it"


def test_of_whatever_is_signed_each_byte_counts() -> None:
    for setting in table(DriverConfig()):
        if setting.part >= start_plan.COB_ID:
            for byte in range(setting.size):
                held = whole(**ALL)
                changed = held | {setting.key: (held[setting.key] or 0) ^ 1 << 8 * byte}
                assert signed(changed) != held[0x2020, 1]


def test_outputs_are_mapped_as_cia_301_has_it() -> None:
    off, on = (0x1400, 1, 0x8000020A), (0x1400, 1, 0x20A)
    entry = [(0x1600, 0, 0), (0x1600, 1, 0x62000108), (0x1600, 0, 1)]
    assert written(whole(**ALL) | {(0x1600, 0): 8}, **ALL) == [off, *entry, on]
    assert written(whole(**ALL) | {(0x1400, 2): 254}, **ALL) == [(0x1400, 2, 1)]


def test_where_rpdo_1_or_tpdo_3_carries_the_combs_there_is_no_room() -> None:
    for config in ({"drive_pdo": 1}, {"sense_pdo": 3}, {"protection": False}):
        both = DriverConfig(**ALL, **config)
        indices = {setting.index for setting in table(both)}
        assert (0x6200 in indices) == ("drive_pdo" not in config)
        assert (0x2020 in indices) == ("drive_pdo" in config)
