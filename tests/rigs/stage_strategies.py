"""Hypothesis strategies for devices and poses: any plausible proportions, not only the two devices that are shipped."""

from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from pkxyz_ctrl.config.files import load, plain
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

SHIPPED = ("reconstructed", "printed")


def stage_with(**sections: dict[str, Any]) -> Stage:
    """The reconstructed stage with some sections' keys replaced; ``geometry`` is replaced as a whole."""
    data = plain(load("stages", "reconstructed", StageConfig))
    for section, changes in sections.items():
        data[section] = dict(changes) if section == "geometry" else data[section] | changes
    return Stage(StageConfig.model_validate(data))


@st.composite
def stages(draw: st.DrawFn) -> Stage:
    """A device of random proportions: links of 0.4 to 1.2 mm at 14 to 57 degrees, cranks of 0.25 to 1 mm."""
    link, elevation = draw(st.floats(0.4e-3, 1.2e-3)), draw(st.floats(0.25, 1.0))
    crank = draw(st.floats(0.25e-3, 1e-3))
    radius = link * np.cos(elevation) + crank + draw(st.floats(0.1e-3, 2e-3))
    return stage_with(
        geometry={
            "base_radius_m": float(radius),
            "crank_length_m": crank,
            "link_length_m": link,
            "elevation_rest_rad": elevation,
        },
        flexures={"out_of_plane_chains": draw(st.sampled_from([1, 3]))},
    )


def shipped() -> st.SearchStrategy[Stage]:
    """One of the shipped devices."""
    return st.sampled_from([Stage.load(name) for name in SHIPPED])


def any_stage() -> st.SearchStrategy[Stage]:
    """A shipped device or one of random proportions."""
    return shipped() | stages()


def positions() -> st.SearchStrategy[Array]:
    """A position (3,) in m that each of these devices reaches: 40 um sideways, -20 to 40 um in height."""
    lateral = st.floats(-40e-6, 40e-6)
    return st.tuples(lateral, lateral, st.floats(-20e-6, 40e-6)).map(np.array)
