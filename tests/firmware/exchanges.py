"""Exchanges to compare: the whole controller in lockstep with a node, from start-up on, and all that can break."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.faults.catalogue import KINDS, PARTS
from hil.faults.fault import Fault
from hil.lanes.blocks import PREVIEW_ROWS, Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.export.calls import Call, RecordedController
from pkxyz_ctrl.export.selftest import Board
from pkxyz_ctrl.export.words import FNV_OFFSET, FNV_PRIME
from pkxyz_ctrl.loop.controller import StartUpError
from pkxyz_ctrl.loop.exchange import NOT_RESTARTED, RESTARTED
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.safety.modes import Mode

Records = NDArray[np.void]

LAWS = ("lqg", "youla", "robust")
_DURATION_S, _AT_S, _LASTS_S, _CLEAR_S = 0.3, 0.15, 0.03, 0.02


class Exchange(NamedTuple):
    """``config`` (1,), ``reference`` (n,) and ``calls`` (m,) as they were; of the calls gone through here again
    ``digests`` (m,) and what was ``told`` (m,), the modes in the end of each, and the words that a board holds.
    """

    name: str
    config: Records
    reference: Records
    calls: Records
    digests: NDArray[np.uint64]
    told: NDArray[np.int64]
    modes: set[int]
    held: NDArray[np.uint64]


def exchanges() -> Iterator[Exchange]:
    """One for each kind of fault, under one law after the other, and one that is cleared in vain."""
    setups = [load_scenario("faults", controller=law).setup() for law in LAWS]
    reset = Fault(target="node", kind="reset", at_s=_AT_S)  # and what starts then is another device
    yield _played(
        "node:reset, wrong_identity, lqg", setups[0], reset, reset.model_copy(update={"kind": "wrong_identity"})
    )
    for n, (target, kind) in enumerate((target, kind) for target, kinds in KINDS.items() for kind in kinds):
        if kind == "killed":  # nothing is called then
            continue
        part = PARTS.get(target, ("",))[0]
        at_s = 0.0 if kind == "wrong_identity" else _AT_S
        where = f"{target}.{part}" if part and kind != "babbling" else target
        fault = Fault(target=where, kind=kind, at_s=at_s, duration_s=_LASTS_S)
        law = n % len(LAWS)
        yield _played(f"{fault.target}:{kind}, {LAWS[law]}", setups[law], fault)


def _played(name: str, setup: Setup, *faults: Fault) -> Exchange:
    setup = dataclasses.replace(setup, duration_s=_DURATION_S, faults=faults, clear_s=_CLEAR_S)
    period_us = setup.bus.period_us
    rig = LockstepRig(setup, whole_ticks=False, controller=RecordedController)
    with contextlib.suppress(StartUpError):  # which has to come with another device in the node's place
        rig.run(Blocks(setup.trajectory, period_us, setup.ticks, lambda _: None, lambda *_: None))
    assert isinstance(rig.controller, RecordedController)
    config, calls = rig.controller.record, rig.controller.calls
    reference = reference_rows(setup.trajectory.sample(0, setup.ticks + PREVIEW_ROWS, period_us))
    board, modes = Board(config, reference), set[int]()
    mode, left = board.memory["cycle"]["mode"][0], []
    for call in calls:
        left.append(board.play(call))
        modes.add(int(mode[0]))
    told = np.array([words[0] for words in left]).view(np.int64)
    return Exchange(name, config, reference, calls, _digests(left), told, modes, board.held())


def _digests(left: list[NDArray[np.uint64]]) -> NDArray[np.uint64]:
    """``words.digest`` of each by itself, of those with as many words in one go."""
    lengths, found = np.array([len(words) for words in left]), np.zeros(len(left), np.uint64)
    for length in np.unique(lengths):
        places = np.flatnonzero(lengths == length)
        found[places] = hashes(np.stack([left[place] for place in places]))
    return found


def hashes(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """``words.digest`` of each row of (n, m)."""
    state = np.full(len(words), FNV_OFFSET, np.uint64)
    with np.errstate(over="ignore"):
        for column in words.T:
            state = (state ^ column) * np.uint64(FNV_PRIME)
    return state


def missing(found: list[Exchange]) -> list[str]:
    """What should have happened in them, and did not."""
    lacking = [f"mode {mode.name}" for mode in Mode if not any(mode in exchange.modes for exchange in found)]
    told = np.concatenate([e.told[np.isin(e.calls["kind"], (Call.BEGIN, Call.FINISH))] for e in found])
    lacking += [f"told {bit}" for bit in (RESTARTED, NOT_RESTARTED) if not (told & bit).any()]
    kinds = {int(kind) for exchange in found for kind in np.unique(exchange.calls["kind"])}
    met = set(Call) - {Call.JUDGE, Call.REQUEST, Call.STOP}
    return lacking + [f"call {call.name}" for call in sorted(met) if call not in kinds]
