"""Kernels called without numba's look at the arguments: the same results, and whose arguments are looked at."""

import numpy as np
import pytest
from numba import njit

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.reference import REFERENCE

ROW = np.dtype([("a", "f8"), ("n", "i4", (3,))], align=True)


@njit
def _mix(row, text, factor):
    r = row[0]
    r["n"][1] += len(text) * factor
    return r["a"] * factor + r["n"][1]


@pytest.mark.parametrize("kernel", [_mix, _mix.py_func], ids=["compiled", "compiler off"])
def test_a_direct_call_does_what_the_kernel_does(kernel) -> None:
    rows = [np.array([(0.1, (1, 2, 3))], ROW) for _ in range(2)]
    called = direct(kernel, rows[0], b"", 0)
    for text, factor in ((b"", 1), (b"abc", -7), (bytes(64), 10**7)):
        assert called(rows[0], text, factor) == _mix.py_func(rows[1], text, factor)
        assert rows[0] == rows[1]
    assert (called is kernel) == (kernel is _mix.py_func)


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        (np.zeros(20, REFERENCE)[::2], "follow one another"),
        (np.zeros((20, 9)), "REFERENCE"),
        (np.zeros(20, np.dtype(REFERENCE.descr[1:])), "REFERENCE"),
        (np.zeros((2, 10), REFERENCE), "REFERENCE"),
        (np.zeros(0, REFERENCE), "n > 0"),
    ],
    ids=["every other", "no record", "another record", "two dimensions", "none"],
)
def test_the_controller_refuses_a_reference_that_the_cycle_would_misread(reference: np.ndarray, words: str) -> None:
    setup = load_scenario("raster").setup()
    controller = Controller(setup.law, setup.bus, setup.gate, lambda frame: None)
    with pytest.raises(ValueError, match=words):
        controller.compute(reference, 0)
    controller.compute(np.zeros(1, REFERENCE), 0)
    assert controller.memory["tick_index"][0] == 1
