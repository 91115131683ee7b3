"""What the stage does otherwise than the model expects: forces out of proportion, strokes that are not believed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import monitor_limits
from monitor_bench import UNMOVED, Bench, beyond, only
from numpy.typing import NDArray

from pkxyz_ctrl.safety.monitors import LIMITS, implausible_combs
from pkxyz_ctrl.safety.trips import Trip


class Trend:
    """A mean that a step of 1/150 a tick makes, by numpy."""

    def __init__(self) -> None:
        self.mean = np.zeros(3)

    def change(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        self.mean = self.mean + 200e-6 / 0.03 * (value - self.mean)
        return value - self.mean


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1.5))
def test_a_change_of_force_trips_where_it_is_out_of_proportion_for_five_ticks(seed: int, share: float) -> None:
    """Oracle: the rule written down for whole histories. A comb makes ``1 - share`` of the force that is commanded."""
    dice = np.random.default_rng(seed)
    commanded = np.repeat(dice.uniform(0.0, 0.5e-3, (12, 3)), 8, axis=0)
    lacking = -share * commanded + dice.normal(0.0, 20e-6, commanded.shape)
    bench, missing, asked = Bench(limits=only("unexplained_force_count", 5)), Trend(), Trend()
    beyond_so_far: list[NDArray[np.bool_]] = []
    for c, f in zip(commanded, lacking, strict=True):
        beyond_so_far.append(np.abs(missing.change(f)) > 32e-6 + 0.47 * np.abs(asked.change(c)))
        expected = np.all(beyond_so_far[-5:], axis=0) & (len(beyond_so_far) >= 5)
        trips = bench.tick({"unexplained_force_n": f, "commanded_force_n": c})
        assert trips == sum(int(Trip.COMB_FORCE_1) << i for i in range(3) if expected[i])


def test_an_imperfect_device_is_in_proportion_and_a_stuck_comb_is_not() -> None:
    for share, tripped in ((0.38, False), (-0.38, False), (1.0, True), (0.0, False)):
        bench = Bench()
        ramp = 4e-6 * np.arange(200)  # a move at 1 mN in 50 ms
        found = [bench.tick({"unexplained_force_n": -share * n, "commanded_force_n": n}) for n in ramp]
        assert any(found) is tripped, share


def test_a_change_that_is_just_in_proportion_is_permitted() -> None:
    """With a trend that stands still: 32 uN and 47 % of 0.5 mN are 267 uN."""
    limits = only("unexplained_force_count", 1)
    limits["force_trend_share"] = 0.0
    edge = float(limits["force_change_max_n"][0] + limits["force_change_share"][0] * 0.5e-3)
    assert edge == pytest.approx(267e-6)
    for comb in range(3):
        asked = {"commanded_force_n": beyond(comb, -0.5e-3)}
        for value, trips in ((edge, Trip(0)), (math.nextafter(edge, 1.0), Trip(Trip.COMB_FORCE_1 << comb))):
            assert Bench(limits=limits).tick({**asked, "unexplained_force_n": beyond(comb, value)}) == trips


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["unexplained_force_n", "commanded_force_n"])
def test_a_force_that_is_not_finite_counts_and_leaves_no_trace(name: str, value: float) -> None:
    bench = Bench(limits=only("unexplained_force_count", 2))
    counted = not (name == "commanded_force_n" and math.isinf(value))  # against an infinite change all is little
    for _ in range(3):
        assert bench.tick({name: value}) == 0
        assert bench.memory["unexplained_force"][0].tolist() == [int(counted)] * 3
        assert bench.tick() == 0
        assert not bench.memory["unexplained_trend_n"].any()
        assert not bench.memory["commanded_trend_n"].any()


def test_a_stroke_is_implausible_from_just_beyond_the_limit() -> None:
    limits = monitor_limits()
    limit = float(limits["residual_max_m"][0])
    assert limit == 0.7e-6
    for comb in range(3):
        for value in (math.nextafter(limit, 1.0), -math.nextafter(limit, 1.0), math.nan, math.inf, -math.inf):
            assert implausible_combs(limits[0], UNMOVED, np.array(beyond(comb, value))) == 1 << comb
    assert implausible_combs(limits[0], UNMOVED, np.array([limit, -limit, 0.0])) == 0
    assert implausible_combs(limits[0], UNMOVED, np.array([1.0, math.nan, -1.0])) == 0b111


def test_what_the_model_may_be_off_by_grows_with_the_change_of_force_and_is_forgotten() -> None:
    """Three combs that change by 1 mN each allow 4.5 um more of innovation and residual at the next sample, and a tenth
    less with each tick. A force that stays, however large, allows nothing."""
    limits = only("innovation_count", 1)
    assert limits["innovation_share_m_per_n"][0] == 1.5e-3
    limits["force_forget_share"] = 0.1
    for after, more_m in ((1, 4.5e-6), (2, 4.05e-6), (11, 4.5e-6 * 0.9**10), (400, 0.0)):
        for factor, expected in ((1.0 - 1e-9, Trip(0)), (1.0 + 1e-9, Trip.INNOVATION_Y)):
            bench = Bench(limits=limits)
            for _ in range(after):
                bench.tick({"commanded_force_n": 1e-3})
            seen = beyond(1, factor * (0.5e-6 + more_m))
            assert bench.tick({"commanded_force_n": 1e-3, "innovation_m": seen}) == expected
        if more_m:
            residual_m = np.array(beyond(2, 0.7e-6 + 0.89 * more_m))
            assert implausible_combs(limits[0], bench.memory[0], residual_m) == 0
            assert implausible_combs(limits[0], UNMOVED, residual_m) == 0b100


@pytest.mark.parametrize("force_n", [math.nan, math.inf, -math.inf])
def test_a_change_of_force_that_is_no_number_allows_nothing(force_n: float) -> None:
    """Were it remembered, an infinite one would allow everything from then on."""
    bench = Bench(limits=only("innovation_count", 1))
    bench.tick({"commanded_force_n": force_n})
    assert bench.tick({"innovation_m": beyond(1, 0.51e-6)}) == Trip.INNOVATION_Y


def test_a_comb_that_is_only_dragged_along_is_not_named() -> None:
    limits = monitor_limits()[0]
    assert implausible_combs(limits, UNMOVED, np.array([9e-6, -2.9e-6, 1.1e-6])) == 0b001
    assert implausible_combs(limits, UNMOVED, np.array([9e-6, -3.0e-6, 3.1e-6])) == 0b111
    assert implausible_combs(limits, UNMOVED, np.array([-1.2e-6, 0.9e-6, 3.5e-6])) == 0b101


def test_a_residual_limit_that_was_never_filled_in_believes_nothing() -> None:
    assert implausible_combs(np.zeros(1, LIMITS)[0], UNMOVED, np.full(3, 1e-12)) == 0b111


@pytest.mark.parametrize("comb", [0, 1, 2])
def test_one_comb_alone_is_named_several_are_the_stage(comb: int) -> None:
    """A sensor or a drive comb goes wrong by itself; what moves the stage is seen by all of them."""
    alone = Bench(limits=only("residual_count", 3))
    assert [alone.tick({"implausible_combs": 1 << comb, "innovation_m": 1e-6}) for _ in range(3)] == [
        0, 0, Trip.COMB_MISFIT_1 << comb,
    ]  # fmt: skip
    others = 0b111 & ~(1 << comb)
    stage = Bench(limits=only("residual_count", 3))
    for axis, trip in enumerate((Trip.INNOVATION_X, Trip.INNOVATION_Y, Trip.INNOVATION_Z)):
        stage = Bench(limits=only("residual_count", 3))
        moved = {"implausible_combs": others, "innovation_m": beyond(axis, 3e-6)}
        assert [stage.tick(moved) for _ in range(3)] == [0, 0, trip]
    both = Bench(limits=only("residual_count", 3))
    moved = {"implausible_combs": 0b111, "innovation_m": [1.0e-6, -0.5e-6, 0.49e-6]}
    assert [both.tick(moved) for _ in range(3)][-1] == Trip.INNOVATION_X | Trip.INNOVATION_Y
    nonsense = Bench(limits=only("residual_count", 1))
    moved = {"implausible_combs": 0b111, "innovation_m": math.nan}
    assert nonsense.tick(moved) | nonsense.tick(moved) >= Trip.INNOVATION_X | Trip.INNOVATION_Y | Trip.INNOVATION_Z


def test_another_combs_single_outlier_does_not_clear_the_culprit() -> None:
    bench = Bench(limits=only("residual_count", 3))
    assert bench.tick({"implausible_combs": 0b101}) == 0
    assert bench.tick({"implausible_combs": 0b001}) == 0
    assert bench.tick({"implausible_combs": 0b001}) == Trip.COMB_MISFIT_1
    bench = Bench(limits=only("residual_count", 3))
    assert bench.tick({"implausible_combs": 0b101, "innovation_m": 1e-6}) == 0
    assert bench.tick({"implausible_combs": 0b101, "innovation_m": 1e-6}) == 0
    assert bench.tick({"implausible_combs": 0b001, "innovation_m": 1e-6}) == 0b111 * Trip.INNOVATION_X


@pytest.mark.parametrize(("worst", "other"), [(i, k) for i in range(3) for k in range(3) if i != k])
def test_a_comb_that_the_worst_one_drags_along_is_not_named(worst: int, other: int) -> None:
    """Whichever two they are; from a third of it on, the other is one by itself."""
    limits = monitor_limits()[0]
    for share, named in ((0.3, [worst]), (0.34, [worst, other])):
        residual_m = np.zeros(3)
        residual_m[worst], residual_m[other] = -6e-6, share * 6e-6
        assert implausible_combs(limits, UNMOVED, residual_m) == sum(1 << comb for comb in named)


def test_a_single_outlier_of_a_second_comb_does_not_take_the_blame_from_the_first() -> None:
    limits = only("residual_count", 3)
    bench = Bench(limits=limits)
    assert [bench.tick({"implausible_combs": combs}) for combs in (1, 1, 3)] == [0, 0, Trip.COMB_MISFIT_1]
    bench = Bench(limits=limits)
    both = [bench.tick({"implausible_combs": combs, "innovation_m": [0.0, 1e-6, 0.0]}) for combs in (1, 3, 3)]
    assert both == [0, 0, Trip.INNOVATION_Y]
