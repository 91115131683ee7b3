"""Callees are a caller's own when LLVM sees them, as numba made them; no bit hangs on it."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from numba import float64, njit

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.compiled.whole_program import optimise_whole_programs

ROOT = Path(__file__).parents[2]


@kernel
def weighted(weights: np.ndarray, values: np.ndarray) -> float:
    total = 0.0
    for i in range(len(values)):
        total += weights[i] * values[i] - 0.1 * total
    return total


@kernel
def twice(weights: np.ndarray, values: np.ndarray) -> float:
    return weighted(weights, values) / (1.0 + abs(weighted(values, weights)))


def library(compiled):
    return compiled.overloads[compiled.signatures[0]].library


def test_a_callee_is_its_callers_own():
    twice.compile((float64[::1], float64[::1]))
    whole = library(twice).get_llvm_str()
    assert "linkonce" not in whole
    handed_on = str(library(twice)._get_module_for_linking())
    assert handed_on.count("define linkonce_odr") >= 2  # itself and what it calls, for whoever calls it
    assert "define dso_local" not in handed_on


def test_its_bits_are_those_of_python():
    draw = np.random.default_rng(5)
    for n in (1, 3, 8, 41):
        a, b = draw.standard_normal((2, n))
        assert twice(a, b) == twice.py_func(a, b)


_PLAIN = """
import sys
from numba.core.codegen import CPUCodeLibrary
plain = CPUCodeLibrary._optimize_final_module
import pkxyz_ctrl.compiled.kernel
assert (CPUCodeLibrary._optimize_final_module is plain) == (sys.argv[1] == "plain")
"""


def test_what_is_exported_is_left_as_numba_makes_it():
    """There it is to optimise nothing, and entries of one module share their callees."""
    for opt, left in (("0", "plain"), ("3", "whole")):
        subprocess.run([sys.executable, "-c", _PLAIN, left], cwd=ROOT, env={**os.environ, "NUMBA_OPT": opt}, check=True)


def test_asking_twice_is_asking_once():
    optimise_whole_programs()

    @njit
    def one_more(x):
        return weighted(x, x)

    assert one_more(np.array([1.0, 2.0])) == weighted.py_func(np.array([1.0, 2.0]), np.array([1.0, 2.0]))
