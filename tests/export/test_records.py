"""Records as C sees them: names, units, words and digests; and a compiler's word that the header is C and C++."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pkxyz_ctrl.core import estimator, feedback
from pkxyz_ctrl.core import tick as ticking
from pkxyz_ctrl.export import structs
from pkxyz_ctrl.export.stored import Stored
from pkxyz_ctrl.export.structs import header, layout, loop_header, struct_name, unit_of
from pkxyz_ctrl.export.words import CANONICAL_NAN, FNV_OFFSET, canonical, digest, words_of
from pkxyz_ctrl.loop import cycle
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.loop.reference import REFERENCE
from pkxyz_ctrl.loop.row import ROW


@pytest.mark.parametrize(
    ("field", "unit"),
    [
        ("velocity_gain_n_s_per_m", "N s/m"), ("position_m", "m"), ("force_gain_n_per_v2", "N/V^2"), ("t_us", "us"),
        ("sense_count", "count"), ("metre_per_farad", "m/F"), ("n", ""), ("e", ""), ("mode", ""), ("order", ""),
        ("homing_ticks", "ticks"), ("crank_n_m_per_rad", "N m/rad"), ("row", ""),
    ],
)  # fmt: skip
def test_units_are_read_from_names(field, unit):
    assert unit_of(field) == unit


@pytest.mark.parametrize(
    ("dtype", "name"),
    [
        (cycle.LAW, "pkxyz_cycle_law"), (cycle.MEMORY, "pkxyz_cycle_memory"), (ticking.LAW, "pkxyz_tick_law"),
        (REFERENCE, "pkxyz_reference"), (ROW, "pkxyz_row"), (estimator.ESTIMATE, "pkxyz_estimator_estimate"),
        (feedback.FEEDBACK, "pkxyz_feedback"),
    ],
)  # fmt: skip
def test_a_struct_is_named_after_where_its_record_stands(dtype, name):
    assert struct_name(dtype) == name


def records_in(dtype, found):
    for field, *_ in (dtype.fields or {}).values():
        if field.base.fields:
            records_in(field.base, found)
    found.append(dtype)
    return found


def test_every_field_of_every_record_is_declared_asserted_and_has_what_is_said_of_it():
    text = header(200, Stored(8136, 11496))
    for root in (EXCHANGE, EXCHANGE_MEMORY, REFERENCE):
        for dtype in records_in(root, []):
            name = struct_name(dtype)
            for field, (_, offset, *_) in dtype.fields.items():
                c_name = {"signed": "signed_"}.get(field, field)  # a word of C
                assert f"PKXYZ_ASSERT(offsetof({name}, {c_name}) == {offset});" in text
            assert f"PKXYZ_ASSERT(sizeof({name}) == {dtype.itemsize});" in text
    assert "    double mass_kg; /* kg */" in text
    assert "    double gain[9][3]; /* steady-state Kalman gain of the measurement update */" in text
    assert "    int32_t drive_count[3]; /* count, goes to the combs at the next SYNC */" in text
    assert "#define PKXYZ_PERIOD_US 200 " in text
    assert "#define PKXYZ_CONFIG_BYTES 8136 " in text
    assert "#define PKXYZ_MEMORY_BYTES 11496 " in text
    assert "    PKXYZ_MODE_TRACKING = 5," in text
    assert "    PKXYZ_REFUSED_DRIVE_STEP = 14," in text
    assert "int32_t flags, int32_t length, int64_t data, int64_t t_us, int64_t *told);" in text


@pytest.mark.parametrize("words", [("-std=c11", "-xc"), ("-std=c++17", "-xc++")])
def test_compilers_hold_every_offset_and_size(tmp_path, words):
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    (tmp_path / "pkxyz.h").write_text(header(200, Stored(8136, 11496)), encoding="utf-8")
    strict = ["-fsyntax-only", "-Wall", "-Wextra", "-Werror"]
    said = subprocess.run(
        [compiler, *words, *strict, tmp_path / "pkxyz.h"], capture_output=True, text=True, check=False
    )
    if "-xc++" in words and "cc1plus" in said.stderr:
        pytest.skip("no C++ compiler")
    assert said.returncode == 0, said.stderr


def test_what_lies_between_fields_is_no_part_of_a_record():
    memory = cycle.new_memory()
    memory.view(np.uint8)[:] = 0xA5
    words = words_of(memory)
    for byte in (0, 1, 0xFF):
        other = np.full(memory.nbytes, byte, np.uint8).view(memory.dtype)
        for name in memory.dtype.names:
            other[name] = memory[name]
        assert np.array_equal(words_of(other), words)


def test_one_not_a_number_is_like_another_and_nothing_else_is():
    rows = np.zeros(2, ROW)
    rows["demand_n"][0, 1] = np.nan
    rows["demand_n"][1, 1] = -np.nan
    first, second = canonical(rows).reshape(2, -1)
    assert np.array_equal(first, second)
    assert (first == CANONICAL_NAN).sum() == 1
    rows["demand_n"][1, 1] = np.inf
    assert not np.array_equal(*canonical(rows).reshape(2, -1))
    rows["tick"] = 0x7FF8_0000_0000_0001  # an integer that looks like one
    assert canonical(rows)[ROW.fields["tick"][1] // 8] == 0x7FF8_0000_0000_0001


def test_digest_is_fnv_1a_over_words():
    assert digest(FNV_OFFSET, np.array([], np.uint64)) == 0xCBF29CE484222325
    assert digest(FNV_OFFSET, np.array([0], np.uint64)) == 0xCBF29CE484222325 * 0x100000001B3 % 2**64
    assert digest(FNV_OFFSET, np.array([1, 2], np.uint64)) != digest(FNV_OFFSET, np.array([2, 1], np.uint64))


SHARED_LIKE = [("first", "i8"), ("inner", [("rows", "f8", (3,)), ("count", "i4")], (2,))]


def digest_of(monkeypatch, fields):
    monkeypatch.setattr(structs, "SHARED", np.dtype(fields, align=True))
    layout.cache_clear()
    try:
        return layout()
    finally:
        layout.cache_clear()


@pytest.mark.parametrize(
    "fields",
    [
        [("other", "i8"), SHARED_LIKE[1]],
        [("first", "u8"), SHARED_LIKE[1]],
        [SHARED_LIKE[1], ("first", "i8")],
        [*SHARED_LIKE, ("behind", "i1")],
        [("first", "i8"), ("inner", SHARED_LIKE[1][1], (3,))],
        [("first", "i8"), ("inner", [("rows", "f8", (3,)), ("number", "i4")], (2,))],
        [("first", "i8"), ("inner", [("rows", "f8", (1, 3)), ("count", "i4")], (2,))],
    ],
    ids=["name", "format", "order", "size", "length", "name within", "shape within"],
)
def test_two_who_share_records_that_stand_otherwise_know_it_by_their_digest(monkeypatch, fields):
    alike = digest_of(monkeypatch, list(SHARED_LIKE))
    assert digest_of(monkeypatch, list(SHARED_LIKE)) == alike
    assert digest_of(monkeypatch, fields) != alike


def test_what_the_numbers_mean_is_in_the_digest_too(monkeypatch):
    before = layout()
    monkeypatch.setattr(structs, "_NUMBERS_SHARED", structs._NUMBERS_SHARED[1:])
    assert digest_of(monkeypatch, structs.SHARED) != before


def test_the_header_has_the_digest_and_who_maps_the_file_reads_no_source_for_it(monkeypatch):
    """It took half a second of each start."""
    said = loop_header()
    layout.cache_clear()
    monkeypatch.setattr(Path, "read_text", lambda path, **words: pytest.fail(f"reads {path}"))
    assert f"#define PKXYZ_LAYOUT {layout():#x}\n" in said
