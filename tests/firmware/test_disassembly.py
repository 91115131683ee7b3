"""The readers of machine code read it: literal listings of each processor, and one of a small program."""

import pytest
from disassembly import fused_instructions, stack_bound


@pytest.mark.parametrize(
    "line",
    [
        "\tvfmadd231sd\t%xmm2, %xmm1, %xmm0", "\tvfma.f64\td0, d1, d2", "  24: \tvfnms.f64 d0, d1, d2",
        "\tfmadd\td0, d1, d2, d3", "\tfmla\tv0.2d, v1.2d, v2.2d", "\tfnmsub\td0, d1, d2, d3",
        "\tfmadd.d\tfa0, fa1, fa2, fa3", "\tfnmadd.d\tfa0, fa1, fa2, fa3",
    ],
)  # fmt: skip
def test_one_rounding_for_two_operations_is_seen(line):
    assert fused_instructions(f"\tnop\n{line}\n") == [line.strip()]


@pytest.mark.parametrize(
    "line",
    [
        "\tvmla.f64\td0, d1, d2", "\tfmul\td0, d1, d2", "\tfmax\td0, d1, d2", "\tfmov\td0, x1", "\tmulsd\t%xmm1, %xmm0",
        "\tfmul.d\tfa0, fa1, fa2", "\tvmls.f64\td0, d1, d2", "\tvsub.f64\td0, d1, d2", "\tfmin.d\tfa0, fa1, fa2",
    ],
)  # fmt: skip
def test_two_roundings_are_not(line):
    assert fused_instructions(f"{line}\n") == []


PROGRAM = """
00000000 <entry>:
   0:\tpush\t{r4, r5, r6, r7, lr}
   2:\tvpush\t{d8-d15}
   4:\tsub\tsp, #40\t@ 0x28
   6:\tbl\t100 <deep>
   8:\tbl\t200 <shallow>
  10:\tpop\t{r4, r5, r6, r7, pc}

00000100 <deep>:
 100:\tstmdb\tsp!, {r4, r5, r6, r7, r8, r9, sl, fp, lr}
 102:\tsubw\tsp, sp, #1028\t@ 0x404
 104:\tb.w\t200 <shallow>

00000200 <shallow>:
 200:\tpush\t{r4-r7, lr}
 202:\tbx\tlr
"""


def test_the_deepest_way_counts_with_all_that_is_pushed_and_reserved():
    entry, deep, shallow = 5 * 4 + 8 * 8 + 40, 9 * 4 + 1028, 5 * 4
    assert stack_bound(PROGRAM, "entry") == (entry + deep + shallow, ["entry", "deep", "shallow"])
    assert stack_bound(PROGRAM, "shallow") == (shallow, ["shallow"])


@pytest.mark.parametrize(("line", "words"), [("\tbl\t0 <entry>", "calls itself"), ("\tblx\tr3", "calls by a register")])
def test_what_has_no_bound_is_refused(line, words):
    with pytest.raises(ValueError, match=words):
        stack_bound(PROGRAM.replace(" 202:\tbx\tlr", f" 202:{line}"), "entry")
