"""A small budget of the fuzzing of ``make fuzz``, and that it would notice."""

import random
from dataclasses import replace

import pytest
from defective.frames import IgnoresCrc, KeepsVoltageInStopped
from fuzz import TARGETS, ViolationError, fuzz_frames, fuzz_gate, fuzz_node
from fuzz_documents import fuzz_documents

from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Mode

SEED = 20  # not that of the long run: these are other frames


@pytest.mark.parametrize("target", TARGETS)
def test_frames(target: str) -> None:
    """Nothing raises, nothing moves that should not; and the fuzz gets as far as where something could."""
    frames, reached = fuzz_frames(target, 20_000, SEED)
    assert frames == 20_000
    assert reached > 20


def test_documents() -> None:
    told = fuzz_documents(600, SEED)
    assert "taken" in told
    assert "refused" in told


def test_the_same_seed_is_the_same_traffic() -> None:
    assert fuzz_frames("gate", 4000, SEED) == fuzz_frames("gate", 4000, SEED)
    assert len({fuzz_frames("gate", 4000, seed) for seed in range(4)}) > 1


@pytest.mark.parametrize("defect", [IgnoresCrc, KeepsVoltageInStopped])
def test_a_defective_node_is_found(defect: type) -> None:
    with pytest.raises(ViolationError):
        fuzz_node(random.Random(1), 80_000, defect)


class NoSlewLimit(TransmitGate):
    def __init__(self, config: GateConfig) -> None:
        super().__init__(config)
        self.record = replace(config, count_slew_max=32767).record


class Forgiving(TransmitGate):
    """Lets the last mode's frames pass in any mode."""

    def check(self, frame, mode, t_us):  # type: ignore[no-untyped-def]
        return super().check(frame, Mode.TRACKING, t_us)


@pytest.mark.parametrize("defect", [NoSlewLimit, Forgiving])
def test_a_defective_gate_is_found(defect: type[TransmitGate]) -> None:
    with pytest.raises(ViolationError):
        fuzz_gate(random.Random(4), 100_000, defect)
