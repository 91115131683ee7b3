"""How well the default law does beside the stage without any feedback: on the plant of the drawing, on a good and a
poor device, in a real room, and there after an identification."""

import math

import numpy as np

from hil.bench.rigs.answers import jump_settled, move_settled, sine_response
from hil.bench.rigs.figure import Figure
from hil.bench.rigs.places import IDENTIFIED, PLACES, followed

LAW, OPEN_LOOP = "youla", "open_loop"
ALLOWED_NM = {"nominal": 0.3}
"""By how much the law may be worse than nothing, where nothing is to be mended."""
SINE_HZ = 1262.0
"""Twice the first resonance."""
WAITED_MS = 20.0
"""So long a step is watched."""


def beside() -> list[Figure]:
    """About the set-point: raster and circle while scanning, and holds, in the axis in which the law errs most; then
    steps and a sine. The target is what the open loop has."""
    places = (*PLACES, IDENTIFIED)
    scans = [figure for place in places for figure in _scans(place)]
    return scans + [figure for place in places if place != "harsh" for figure in _answers(place)]


def _scans(place: str) -> list[Figure]:
    figures = []
    for scenario in ("raster", "circle"):
        law, nothing = followed(scenario, place, None), followed(scenario, place, OPEN_LOOP)
        allowed = ALLOWED_NM.get(place, 0.0)
        what = [(scenario, "rms_error_nm", "while scanning")]
        if scenario == "raster":
            what.append(("hold", "hold_rms_nm", "in holds"))
        for name, key, words in what:
            ours, theirs = getattr(law, key), getattr(nothing, key)
            worst = max(ours, key=lambda axis: ours[axis])
            detail = f"rms about the set-point {words}, in {worst} ({_axes(ours)}); open loop {_axes(theirs)}"
            target = round(theirs[worst] + allowed, 2)
            figures.append(Figure(f"beside.{name}_{place}", ours[worst], "nm", target, "at most", None, detail))
    return figures


def _answers(place: str) -> list[Figure]:
    """Moves and jumps of 1 um, the worst axis; and by how much a sine is too large or too small, x and y."""
    figures = []
    for name, settled in (("move", move_settled), ("jump", jump_settled)):
        ours, theirs = (round(settled(law, place).s * 1e3, 1) for law in (LAW, OPEN_LOOP))
        detail = f"1 um {name}, the worst axis, to within 10 nm of the set-point for good; open loop {_told(theirs)}"
        target = min(theirs, WAITED_MS)
        figures.append(Figure(f"beside.{name}_{place}", ours, "ms", target, "at most", None, detail))
    ours_db, theirs_db = (
        [float(20 * np.log10(abs(sine_response(axis, SINE_HZ, law, place)))) for axis in "xy"]
        for law in (LAW, OPEN_LOOP)
    )
    worst = int(np.argmax(np.abs(ours_db)))
    detail = (
        f"100 nm sine at {SINE_HZ:g} Hz, {ours_db[0]:+.2f} dB in x, {ours_db[1]:+.2f} in y; "
        f"open loop {theirs_db[0]:+.2f}, {theirs_db[1]:+.2f}"
    )
    off_db, target = abs(ours_db[worst]), round(abs(theirs_db[worst]), 2)
    return [*figures, Figure(f"beside.sine_{place}", off_db, "dB off", target, "at most", None, detail)]


def _told(ms: float) -> str:
    return f"{ms:.1f} ms" if math.isfinite(ms) else f"not in {WAITED_MS:g} ms"


def _axes(values: dict[str, float]) -> str:
    return " / ".join(f"{v:.2f}" for v in values.values())
