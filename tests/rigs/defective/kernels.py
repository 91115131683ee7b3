"""Compiled kernels with a defect: the same code, but some of what it calls is something else."""

from types import FunctionType
from typing import Any

import pytest
from numba import njit

from pkxyz_ctrl.can import driver_rules
from pkxyz_ctrl.loop import exchange
from pkxyz_ctrl.safety import gate_rules


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


@njit
def lets_outputs_pass(memory, length, word, permitted):
    """In place of the gate's ``judge_outputs``."""
    return 0


@njit
def looks_at_bits_alone(memory, length, word, permitted):
    """In place of the gate's ``judge_outputs``."""
    return 0 if word & 0xFF & ~gate_rules.OUTPUT_BITS == 0 else 1


@njit
def drives_nothing(config, memory, first, second, third):
    """In place of the driver's ``drive``."""


@njit
def drives_behind_outputs(config, memory, first, second, third):
    """In place of the driver's ``drive``: digital outputs go first."""
    if memory[0]["has_outputs"] != 0:
        driver_rules.put(config[0], memory[0], config[0]["output_id"], 1, 1)
    driver_rules.drive(config, memory, first, second, third)


def without_gate(patch: pytest.MonkeyPatch, check: Any = lets_pass, **others: Any) -> None:
    """Controllers from now on send what they want, or what ``check`` lets pass; ``others`` than ``finish`` calls
    besides.
    """
    one = planted(exchange.judge_one, check=check)
    every = planted(exchange.judge, judge_one=one)
    begin, finish = exchange.begin, exchange.finish
    patch.setattr(exchange, "begin", planted(begin, judge=every))
    patch.setattr(exchange, "finish", planted(finish, judge=every, judge_one=one, **others))


def without_output_rules(patch: pytest.MonkeyPatch, rule: Any = lets_outputs_pass, **others: Any) -> None:
    """Digital outputs pass the gate, whatever they are, or by ``rule``; ``others`` than ``finish`` has besides."""
    judge = planted(gate_rules._judge, judge_outputs=rule)
    without_gate(patch, planted(gate_rules.check, _judge=judge), **others)


def without_release(patch: pytest.MonkeyPatch) -> None:
    """A node stays operational in FAULT."""
    patch.setattr(exchange, "begin", planted(exchange.begin, release=says_nothing))
