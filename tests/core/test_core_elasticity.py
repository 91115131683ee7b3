"""The arcsine of the flexures: the same bits on every machine, and right."""

import math

import pytest

from pkxyz_ctrl.core.elasticity import arcsine


@pytest.mark.parametrize("size", [1e-9, 0.05, 0.0999999, 0.1, 0.1000001, 0.19, 0.38, 0.7, 0.99, 1.0 - 1e-15, 1.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_arcsine_meets_the_library_all_the_way(size, sign):
    y = sign * size
    assert abs(arcsine(y) - math.asin(y)) <= 4 * math.ulp(math.asin(y))


@pytest.mark.parametrize("y", [1.0 + 1e-15, -2.0, math.inf, math.nan])
def test_arcsine_beyond_one_is_not_a_number(y):
    assert math.isnan(arcsine(y))
