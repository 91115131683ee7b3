"""What stands in for missing instructions: compiled for this machine and held to Python's own numbers."""

import ctypes
import math
import struct

import llvmlite.binding as llvm
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkxyz_ctrl.export import runtime

DOUBLES = st.integers(0, 2**64 - 1).map(lambda bits: struct.unpack("<d", struct.pack("<Q", bits))[0])
D, I64, U64 = ctypes.c_double, ctypes.c_int64, ctypes.c_uint64


@pytest.fixture(scope="module")
def function():
    """Looks a function up by its name and the types of its result and its argument."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    text = runtime.FLOOR + runtime.CONVERSIONS + runtime.DIVISIONS + runtime.SQUARE_ROOT
    text += "declare double @llvm.fabs.f64(double)\n"
    module = llvm.parse_assembly(text.replace("define internal", "define"))
    module.verify()
    engine = llvm.create_mcjit_compiler(module, llvm.Target.from_default_triple().create_target_machine())
    engine.finalize_object()
    yield lambda name, *types: ctypes.CFUNCTYPE(*types)(engine.get_function_address(f"pkxyz.{name}"))
    engine.close()


def bits(x):
    return struct.pack("<d", x)


def test_square_root_is_correctly_rounded_and_keeps_what_has_none(function):
    root = function("sqrt", D, D)

    @given(DOUBLES)
    def check(x):
        if x < 0.0 or math.isnan(x):
            assert math.isnan(root(x))
        else:
            assert root(x) == math.sqrt(x)

    check()
    for x in (0.0, -0.0, 5e-324, 2.2250738585072014e-308, 1.0, 4.0 - 5e-16, math.inf):
        assert bits(root(x)) == bits(math.sqrt(x))


def test_floor_is_that_of_python(function):
    floor = function("floor", D, D)

    @given(st.one_of(DOUBLES, st.floats(-1e6, 1e6)))
    def check(x):
        if math.isfinite(x):
            assert floor(x) == math.floor(x)

    check()
    assert math.isnan(floor(math.nan))
    assert [floor(x) for x in (math.inf, -math.inf)] == [math.inf, -math.inf]
    for x in (0.0, -0.5, -1.0, 2.0**52 - 0.5, -(2.0**52) + 0.5, 2.0**52, 2.0**53):
        assert floor(x) == math.floor(x)


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 63))
def test_integers_to_doubles_are_rounded_once(function, whole, shift):
    assert function("from_i64", D, I64)(whole >> shift) == float(whole >> shift)
    assert function("from_u64", D, U64)(whole % 2**64 >> shift) == float(whole % 2**64 >> shift)


@given(st.floats(-(2.0**62), 2.0**62), st.integers(0, 70))
def test_doubles_to_integers_are_cut_towards_zero(function, x, shift):
    assert function("to_i64", I64, D)(x / 2.0**shift) == int(x / 2.0**shift)


SIGNED = st.integers(-(2**63), 2**63 - 1)


@given(SIGNED, st.one_of(SIGNED, st.integers(-5, 5), st.integers(-(2**32), 2**32)), st.integers(0, 63))
def test_whole_numbers_are_divided_as_a_processor_divides(function, a, b, shift):
    a, b = a >> shift, b or 1
    if b == -1:
        a = max(a, -(2**63) + 1)  # the one quotient that there is no room for
    towards_zero = abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)
    assert function("sdiv", I64, I64, I64)(a, b) == towards_zero
    assert function("srem", I64, I64, I64)(a, b) == a - towards_zero * b
    wide_a, wide_b = a % 2**64, b % 2**64
    assert function("udiv", U64, U64, U64)(wide_a, wide_b) == wide_a // wide_b
    assert function("urem", U64, U64, U64)(wide_a, wide_b) == wide_a % wide_b
