"""The kernel by which a law takes over, beside the same in plain numpy: every bit, for any content of both."""

import numpy as np
import pytest

from pkxyz_ctrl.core import youla
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.law_change import change_to, take_over


def plainly(present, memory, new, heard):
    """As written in numpy, which copies and allocates."""
    before, after, state = present["tick"][0].copy(), new["tick"][0], memory["tick"][0]
    added = state["adaptation"]["added_n"].copy() if before["adaptation"]["on"] else np.zeros(3)
    adapts_alike = bool(np.all(present["tick"]["adaptation"] == new["tick"]["adaptation"]))
    present[:] = new
    moved = before["estimator"]["operating_point_m"] - after["estimator"]["operating_point_m"]
    for estimate in ("predicted", "filtered", "ahead"):
        state["estimate"][estimate][0:3] += moved
    state["set_point_model"]["state"][0:3] += moved
    if not adapts_alike:
        state["adaptation"] = np.zeros((), state["adaptation"].dtype)
        for estimate in ("predicted", "filtered", "ahead"):
            state["estimate"][estimate][6:9] -= added
        added = np.zeros(3)
    state["held_n"] = state["feedforward_n"] + added
    youla.clear(state["youla"])
    state["youla"]["faded"] = 0
    state["linear"]["x"] = heard
    state["set_point_model"]["foreseen"] = 0
    return adapts_alike


def filled(dtype, dice):
    """(1,), every number of it some other one."""
    record = np.zeros(1, dtype)
    for part, kind in flat(record):
        part[...] = dice.standard_normal(part.shape) if kind == "f" else dice.integers(0, 99, part.shape)
    return record


def flat(record):
    """Views of all that is no record itself, with the kind of number."""
    for name in record.dtype.names:
        part = record[name]
        if part.dtype.names:
            yield from flat(part)
        else:
            yield part, part.dtype.kind


def same(one, other):
    return all(a.tobytes() == b.tobytes() for (a, _), (b, _) in zip(flat(one), flat(other), strict=True))


@pytest.mark.parametrize("seed", range(12))
def test_a_law_takes_over_as_it_does_in_numpy(seed):
    dice = np.random.default_rng(seed)
    present, new, memory = filled(cycling.LAW, dice), filled(cycling.LAW, dice), filled(cycling.MEMORY, dice)
    present["tick"]["adaptation"]["on"] = seed % 2
    memory["tick"]["to_learn"] = memory["tick"]["to_follow"] = 0  # the last period is through
    if seed % 3 == 0:
        new["tick"]["adaptation"] = present["tick"]["adaptation"]
    heard = dice.standard_normal(24)
    want_law, want_memory = present.copy(), memory.copy()
    alike = plainly(want_law, want_memory, new, heard)
    assert alike == (seed % 3 == 0)
    take_over(present, memory, change_to(new, heard, adapts_alike=alike))
    assert same(present, want_law)
    assert same(memory, want_memory)
