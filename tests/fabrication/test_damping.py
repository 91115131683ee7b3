"""Quality factor from pressure."""

import numpy as np
import pytest
from process_rig import SHIPPED, devices, process

from pkxyz_ctrl.fabrication.damping import (
    ATMOSPHERE_PA,
    VISCOSITY_PA_S,
    knudsen,
    sliding_viscosity_pa_s,
    squeezed_viscosity_pa_s,
)

PRESSURES_PA = np.array([[101325.0], [1e4], [1e3], [1e2], [10.0], [5.0], [1e-5]])


def test_it_rises_as_the_gas_thins_out_and_ends_at_that_of_the_anchors():
    quality = devices(pressure_pa=PRESSURES_PA).quality_factor
    assert (np.diff(quality) > 0).all()
    assert quality[0] == pytest.approx(20.0, rel=1e-12)
    assert 20.0 < quality[1] < 24.0  # a tenth of an atmosphere: films and trenches are still continua
    assert quality[-1] == pytest.approx(SHIPPED.made_of.vacuum_quality_factor, rel=1e-3)


def test_viscosities_are_that_of_air_in_wide_gaps_and_fall_with_the_pressure_in_narrow_ones():
    for law in (sliding_viscosity_pa_s, squeezed_viscosity_pa_s):
        assert law(np.array(1e-6)) == pytest.approx(VISCOSITY_PA_S, rel=1e-5)
    free = np.array([500.0, 800.0])
    sliding = sliding_viscosity_pa_s(free)
    assert sliding[0] / sliding[1] == pytest.approx(1.6, rel=0.01)  # free molecules: as the pressure
    assert knudsen(np.array(ATMOSPHERE_PA), 5e-6) == pytest.approx(0.0132, rel=0.01)


def test_films_that_are_compressed_are_told():
    # squeeze number 1 at 7.8 Pa: 12 x 18.3 uPa s x 2 pi 631 Hz x (90 um / 30 um)^2
    assert devices(pressure_pa=PRESSURES_PA).film_valid.tolist() == [True] * 5 + [False] * 2


def test_more_overlap_of_fingers_damps_more():
    thicker = devices(layer_1_m=[[0.0], [9e-6]])
    damping = np.sqrt(thicker.mass_kg * thicker.slider_n_per_m.mean(axis=1)) / thicker.quality_factor
    assert damping[1] > damping[0]


def test_films_that_damp_more_than_the_drawing_says_are_refused():
    tight = process().model_copy(update={"made_of": SHIPPED.made_of.model_copy(update={"leaf_gap_m": 5e-6})})
    with pytest.raises(ValueError, match="widen made_of"):
        devices(of=tight)


@pytest.mark.filterwarnings("error")
def test_without_gas_that_of_the_anchors_is_left():
    vacuum = devices(pressure_pa=[[0.0]])
    assert vacuum.quality_factor.tolist() == [SHIPPED.made_of.vacuum_quality_factor]
    assert vacuum.film_valid.tolist() == [False]


@pytest.mark.filterwarnings("error")
def test_a_spread_of_the_pressure_that_goes_below_0_is_refused():
    with pytest.raises(ValueError, match=r"leaves a pressure of -5 Pa .* too wide"):
        devices(pressure_pa=[[101325.0], [-5.0]])
