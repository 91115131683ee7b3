"""Writes docs/figures/laws.png: what each part of the law is worth, by runs of the fast lane without that part."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.signal
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.pictures.style import BLUE, FAINT, MUTED, SMALL_PT, VERMILION, WASH, dress, legend, save, sheet
from hil.runs.scenario import load_scenario


def rows_of(setup: Setup, law: NDArray[np.void] | None = None) -> NDArray[np.void]:
    """All rows of a fast-lane run; ``law`` replaces the designed numbers."""
    if law is not None:
        setup = replace(setup)
        setup.__dict__["law"] = law
    blocks: list[NDArray[np.void]] = []
    lanes.run(setup, Lane.FAST, on_block=lambda block: blocks.append(block.copy()))
    return np.concatenate(blocks)


def changed(setup: Setup, change: str) -> NDArray[np.void]:
    """The setup's law with one part taken out."""
    law = setup.law.copy()
    feedback = law["tick"]["feedback"]
    if change == "no feedback":
        feedback["authority_force_n"] = 1e9
    elif change == "feed-forward at the sample":
        feedback["lead_s"] = 0.0
    elif change == "no noise shaping":
        law["tick"]["drive"]["noise_shaping"] = 0
    return law


def error_nm(rows: NDArray[np.void], axis: int) -> NDArray[np.float64]:
    """True position less reference in nm."""
    return (rows["position_m"][:, axis] - rows["reference_m"][:, axis]) * 1e9


def draw_errors(figure: Figure) -> None:
    """Error in x on two lines of the mild plant, whole and without its parts."""
    scenario = load_scenario("raster_mild", controller="lqg")
    setup = scenario.setup()
    whole = rows_of(setup)
    axes = figure.add_subplot(1, 2, 1)
    window = slice(*np.searchsorted(whole["t_us"], [400_000, 440_000]))
    t_ms = (whole["t_us"][window] - 400_000) * 1e-3
    for name, colour in (("no feedback", FAINT), ("feed-forward at the sample", VERMILION)):
        error = error_nm(rows_of(setup, changed(setup, name)), 0)[window]
        offset = error.mean() if name == "no feedback" else 0.0
        label = f"{name} (less its mean, {offset:.0f} nm)" if offset else name
        axes.plot(t_ms, error - offset, color=colour, label=label)
    axes.plot(t_ms, error_nm(whole, 0)[window], color=BLUE, label="the whole law")
    dress(axes, "time (ms)", "error in x (nm)", "Two lines of a raster, mild plant")
    axes.set_ylim(-27, 45)
    legend(axes, "upper right")


def draw_quantisation(figure: Figure) -> None:
    """Spectrum of the voltage's rounding error while holding, with and without noise shaping."""
    setup = load_scenario("raster", controller="lqg").setup()
    axes = figure.add_subplot(1, 2, 2)
    gain = setup.law["tick"]["drive"]["force_gain_n_per_v2"][0]
    for name, colour in (("no noise shaping", VERMILION), ("noise shaping", BLUE)):
        rows = rows_of(setup, changed(setup, name))
        hold = rows[(rows["t_us"] > 950_000)]
        rounding_v = hold["voltage_v"] - np.sqrt(hold["force_n"] / gain)
        rate_hz = 1 / setup.bus.period_s
        f, density = scipy.signal.welch(rounding_v, rate_hz, nperseg=256, axis=0)
        axes.loglog(f[1:], np.sqrt(density.mean(axis=1))[1:] * 1e6, color=colour, label=name)
    f = np.array([20.0, 2500.0])
    axes.axvspan(20, 772, color=WASH, zorder=0)
    axes.annotate("the stage follows", (24, 6), color=MUTED, fontsize=SMALL_PT)
    axes.set_xlim(*f)
    dress(axes, "frequency (Hz)", "voltage error (µV/√Hz)", "Rounding to 6.1 mV counts, while holding")
    legend(axes, "lower right")


def main() -> None:
    """Draw both panels."""
    figure = sheet(11, 4.2)
    draw_errors(figure)
    draw_quantisation(figure)
    save(figure, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
