"""The picture of an identification: nine entries, measured and fitted, coherence, and what the fit leaves."""

from pathlib import Path

import numpy as np

from hil.pictures.style import AXIS, FAINT, INK, LABEL_PT, dress, legend, save, sheet
from hil.studies.identify.identification import Identification


def draw_response(found: Identification, path: Path) -> None:
    """Rows: sense chains. Left: size of the three entries in each comb's V^2; then phase of the chain's own comb; then
    coherence, and the residual in standard errors.
    """
    hz = ", ".join(f"{v:.1f}" for v in found.modes.frequency_hz)
    setup = found.setup
    figure = sheet(
        13.5,
        9.0,
        f"{setup.stage.name}, plant {setup.plant.name}, {setup.controller.name} on {setup.bus.name}: "
        f"modes at {hz} Hz (dashed), chi-square {found.modes.chi_square:.2f}",
    )
    panels = figure.subplots(3, 4, sharex=True, width_ratios=(2.2, 1.4, 1.0, 1.0))
    r, modes = found.response, found.modes
    f = r.frequency_hz
    fine = np.unique(
        np.r_[np.geomspace(f[0], modes.used_hz[1], 600), np.linspace(0.8, 1.2, 400) * modes.frequency_hz[1]]
    )
    fitted, at_tones = modes.response(fine), modes.response(f)
    used = f <= modes.used_hz[1]
    for i, row in enumerate(panels):
        size, phase, coherence, left = row
        for j, colour in enumerate(AXIS):
            name = f"comb {j + 1}" + (" (its own)" if i == j else "")
            size.errorbar(
                f, np.abs(r.p[:, i, j]), yerr=r.standard_error[:, i, j], fmt=".", ms=3, lw=0.6, color=colour, alpha=0.55
            )
            size.plot(fine, np.abs(fitted[:, i, j]), color=colour, lw=1.3, label=name)
            apart = r.p[used, i, j] - at_tones[used, i, j]
            left.plot(f[used], np.abs(apart) / r.standard_error[used, i, j], ".", ms=3, color=colour, alpha=0.6)
        phase.plot(f, _degrees(r.p[:, i, i]), ".", ms=3, color=AXIS[i], alpha=0.55)
        phase.plot(fine, _degrees(fitted[:, i, i]), color=AXIS[i], lw=1.2)
        coherence.plot(f, r.coherence[:, i], color=INK, lw=1.0)
        for axes in (size, phase):
            for mode_hz in modes.frequency_hz:
                axes.axvline(mode_hz, color=FAINT, lw=0.8, ls="--", zorder=0)
        size.set(yscale="log", ylabel=f"chain {i + 1} (counts / V$^2$)")
        legend(size, "lower left")
        phase.set(ylim=(-400, 40), yticks=(-360, -270, -180, -90, 0))
        coherence.set(ylim=(0.0, 1.03))
        left.set(ylim=(0.0, 5.0))
    titles = (
        "size: measured (points), fit (lines)",
        "phase, own comb (deg)",
        "coherence",
        "misfit (standard errors)",
    )
    for axes, title in zip(panels[0], titles, strict=True):
        axes.set_title(title, fontsize=LABEL_PT)
    for row in range(3):
        for axes in panels[row]:
            axes.set_xscale("log")
            dress(axes, "frequency (Hz)" if row == 2 else "")
    save(figure, path)


def _degrees(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.degrees(np.unwrap(np.angle(values), discont=1.2 * np.pi)))
