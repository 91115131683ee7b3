"""Compiled kernels with a defect: the same code, but some of what it calls is something else."""

from types import FunctionType
from typing import Any

import pytest
from numba import njit

from pkxyz_ctrl.can import driver_rules
from pkxyz_ctrl.loop import exchange


def planted(kernel: Any, **others: Any) -> Any:
    """``kernel`` with other functions under the names of those that it calls."""
    own = getattr(kernel, "py_func", kernel)
    names = own.__globals__
    assert others.keys() <= names.keys(), "the kernel calls nothing of that name"
    return njit(error_model="numpy")(FunctionType(own.__code__, names | others, own.__name__))


@njit
def lets_pass(config, memory, can_id, flags, length, word, mode, t_us):
    """In place of the gate's ``check``."""
    return 0


@njit
def says_nothing(config, memory, t_us):
    """In place of a kernel of the driver that sends something."""


@njit
def drives_always(config, memory, first, second, third):
    """In place of the driver's ``drive``: a voltage, whatever the law and the mode say."""
    driver_rules.drive(config, memory, 10, 10, 0)


def without_gate(patch: pytest.MonkeyPatch, **others: Any) -> None:
    """Controllers from now on send what they want; ``others`` than ``finish`` calls besides."""
    one = planted(exchange.judge_one, check=lets_pass)
    every = planted(exchange.judge, judge_one=one)
    begin, finish = exchange.begin, exchange.finish
    patch.setattr(exchange, "begin", planted(begin, judge=every))
    patch.setattr(exchange, "finish", planted(finish, judge=every, judge_one=one, **others))
