"""Callees are a caller's own when LLVM sees them, as numba made them; no bit hangs on it."""

import math
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from numba import float64, njit

from pkxyz_ctrl.compiled.whole_program import optimise_whole_programs, rare

optimise_whole_programs()

ROOT = Path(__file__).parents[2]

fresh = njit(error_model="numpy", _nrt=False)  # a kernel that is not kept: of one that was loaded numba shows nothing


@fresh
def weighted(weights: np.ndarray, values: np.ndarray) -> float:
    total = 0.0
    for i in range(len(values)):
        total += weights[i] * values[i] - 0.1 * total
    return total


@fresh
def twice(weights: np.ndarray, values: np.ndarray) -> float:
    return weighted(weights, values) / (1.0 + abs(weighted(values, weights)))


@fresh
def winding(values: np.ndarray) -> float:
    """Too long to be inlined."""
    x, total = 1.0, 0.0
    for i in range(len(values)):
        x = 0.5 * (x + values[i] / x)
        if x > values[i]:
            total += math.sqrt(x) + math.atan2(x, values[i]) - math.pow(x, 0.3)
        elif total > 3.0:
            total -= math.atan(x) + math.hypot(x, total)
        else:
            total = math.atan2(total, x) + math.pow(1.5, x) + math.erf(x)
    for i in range(len(values) - 1):
        total += math.pow(abs(values[i]), 0.2) * math.atan2(values[i + 1], x) + math.gamma(1.0 + abs(values[i]))
        total = total - math.floor(total) if total > 2.0 else total + math.erfc(total)
    return total


@fresh
def thrice(a: np.ndarray, b: np.ndarray) -> float:
    return winding(a) + winding(b) * winding(a)


@fresh
def chains(values: np.ndarray, out: np.ndarray) -> None:
    """Three times as much as a hundred instructions."""
    for i in range(3):
        x = values[i]
        for _ in range(2):
            x = math.sqrt(x * x + 1.0) / (0.3 + x) + math.sqrt(0.5 + x) / (1.0 + x * (0.2 + x * (0.7 + x)))
            x = x * (1.0 + x * (0.25 + x * (0.125 + x * (0.0625 + x)))) - x / (3.0 + x * (2.0 + x * (1.5 + x)))
        out[i] = x


@fresh
def neighbours(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    x, y = a[0] * b[0] + a[2], a[1] * b[1] + a[3]
    out[0], out[1] = x, y


seldom = fresh(rare(types.FunctionType(winding.py_func.__code__, globals())))


@fresh
def seldom_or_often(a: np.ndarray, b: np.ndarray) -> float:
    return winding(a) + winding(b) if a[0] < b[0] else seldom(a) + seldom(b)


def library(compiled):
    return compiled.overloads[compiled.signatures[0]].library


def test_a_callee_is_its_callers_own():
    twice.compile((float64[::1], float64[::1]))
    whole = library(twice).get_llvm_str()
    assert "linkonce" not in whole
    handed_on = str(library(twice)._get_module_for_linking())
    assert handed_on.count("define linkonce_odr") >= 2  # itself and what it calls, for whoever calls it
    assert "define dso_local" not in handed_on


def test_what_stays_a_function_is_known_to_nobody_else():
    """The loader would take one that is local to an object for another's of the same name, with other arguments."""
    thrice.compile((float64[::1], float64[::1]))
    whole = library(thrice).get_llvm_str()
    assert "define private" in whole
    assert "define internal" not in whole
    values = np.array([0.3, 1.7, 0.9, 2.2])
    assert thrice(values, values[1:]) == pytest.approx(thrice.py_func(values, values[1:]), rel=1e-14)


def test_a_loop_of_long_rounds_stays_a_loop():
    """So that what is fetched is one round's code: three chains rolled out have twelve roots."""
    chains.compile((float64[::1], float64[::1]))
    assert 1 <= library(chains).get_llvm_str().count("@llvm.sqrt.f64(double %") <= 4
    values, out = np.array([0.3, 1.7, 0.9]), np.empty(3)
    chains(values, out)
    again = np.empty(3)
    chains.py_func(values, again)
    assert np.array_equal(out, again)


def test_like_operations_on_neighbours_are_one():
    neighbours.compile((float64[::1], float64[::1], float64[::1]))
    whole = library(neighbours).get_llvm_str()
    assert "fmul <2 x double>" in whole
    assert "<4 x double>" not in whole


def test_llvm_knows_what_is_rare():
    seldom_or_often.compile((float64[::1], float64[::1]))
    whole = library(seldom_or_often).get_llvm_str()
    groups = dict(re.findall(r"define private .*?(winding(?:_rarely)?)B.* #(\d+) ", whole))
    told = {
        name: re.search(rf"^attributes #{group} = {{ (\w+) ", whole, re.MULTILINE)[1] for name, group in groups.items()
    }
    assert told.pop("winding_rarely") == "cold"
    assert told.keys() == {"winding"}
    assert "cold" not in told.values()


def test_its_bits_are_those_of_python():
    draw = np.random.default_rng(5)
    for n in (1, 3, 8, 41):
        a, b = draw.standard_normal((2, n))
        assert twice(a, b) == twice.py_func(a, b)


_ROWS = """
import sys
import numpy as np
from pkxyz_ctrl.compiled.kernel import kernel

THREE, FIVE = (np.ones(2, np.dtype([("x", np.float64, (n,))])) for n in (3, 5))

@kernel
def first(rows):
    total = 0.0
    for i in range(rows[0].x.size):
        total += rows[0].x[i]
    return total

@kernel
def of_three(rows):
    return first(rows)

@kernel
def of_five(rows):
    return first(rows)

@kernel
def by_callers(three, five):
    return 100.0 * of_three(three) + of_five(five)

@kernel
def by_itself(three, five):
    return 100.0 * first(three) + first(five)

if __name__ == "__main__":
    print(eval(sys.argv[1]), sum(len(kept.stats.cache_hits) for kept in (first, of_three, of_five)))
"""


@pytest.mark.parametrize(
    ("one", "other", "both"),
    [
        ("of_three(THREE)", "of_five(FIVE)", "by_callers(THREE, FIVE)"),
        ("first(THREE)", "first(FIVE)", "by_callers(THREE, FIVE)"),
        ("first(THREE)", "first(FIVE)", "by_itself(THREE, FIVE)"),
    ],
)
def test_what_two_processes_left_in_the_cache_is_not_taken_for_one(one, other, both, tmp_path):
    """``first`` of three numbers and ``first`` of five are each the first function of the first record of a process,
    which numba's own names tell apart by no more; a third process loads both and calls them from one kernel.
    """
    script = tmp_path / "rows.py"
    script.write_text(_ROWS)
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(ROOT)}
    printed = [
        subprocess.run([sys.executable, script, words], env=env, check=True, capture_output=True, text=True).stdout
        for words in (one, other, both)
    ]
    assert printed == ["3.0 0\n", "5.0 0\n", "305.0 2\n"]  # the number, and how many kernels were loaded


_PLAIN = """
import sys
from numba.core.bytecode import FunctionIdentity
from numba.core.codegen import CPUCodeLibrary
plain = CPUCodeLibrary._optimize_final_module
import pkxyz_ctrl.compiled.kernel
is_plain = sys.argv[1] == "plain"
assert (CPUCodeLibrary._optimize_final_module is plain) == is_plain
assert (FunctionIdentity.from_function(lambda: 0).unique_id < 1000) == is_plain
"""


def test_what_is_exported_is_left_as_numba_makes_it():
    """There it is to optimise nothing, and entries of one module share their callees."""
    for opt, left in (("0", "plain"), ("3", "whole")):
        env = {**os.environ, "NUMBA_OPT": opt}
        assert subprocess.run([sys.executable, "-c", _PLAIN, left], cwd=ROOT, env=env, check=False).returncode == 0
