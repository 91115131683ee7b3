"""Writes docs/figures/plant_noise.png and plant_noise.json, the table of plant.md: each noise of the plant lab alone.

    python docs/figures/plant_noise.py

The stage is held by 130 V on each comb, which is close to mid-workspace, without any feedback.
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from hil.pictures.style import MUTED, SERIES, dress, legend, save, sheet
from hil.runs.scenario import load_scenario
from sim.config import PlantConfig
from sim.plant import Plant

Array = NDArray[np.float64]

TABLE = Path(__file__).with_suffix(".json")
"""Standard deviations in nm along x, y, z by noise, and what each does; the site's table."""
VOLT, REST_S, LOOKED_S = 130.0, 0.2, 20.0
RANDOM = (
    "drift", "brownian", "amplifier_noise", "base_noise", "floor_vibration", "mains", "sense_noise", "sense_flicker",
    "sense_drift",
)  # fmt: skip
MOVES = {
    "brownian": "thermal force",
    "amplifier_noise": "amplifier",
    "base_noise": "table above its legs",
    "floor_vibration": "floor through the legs",
    "mains": "mains, 50 to 300 Hz",
    "drift": "warming package",
}
SHOWS = {"sense_noise": "sense chain, white", "sense_flicker": "sense chain, 1/f", "sense_drift": "sense chain, walk"}
QUIET = {"charging": {"on": False}, "temperature": {"on": False}}
"""What would drift over 20 s without being noise."""


def alone(names: tuple[str, ...], seconds: float = LOOKED_S) -> tuple[Array, Array]:
    """True position (n, 3) and what the sense chain shows beside it, as strokes (n, 3), in nm, with these noises on."""
    setup = load_scenario("raster_lab").setup()
    data = setup.plant.model_dump()
    for name in RANDOM:
        data[name]["on"] = name in names
    data |= {name: data[name] | off for name, off in QUIET.items()}
    if "sense_noise" not in names:
        data["sense_noise"]["sampled"] = "per_sample"
    analog, period_us = setup.bus.analog, setup.bus.period_us
    plant = Plant(
        PlantConfig.model_validate(data), setup.device, period_us=period_us, seed=1,
        drive_scale_v_per_count=analog.drive_volt_per_count, sense_scale_f_per_count=1e-19,
        sense_offset_f=analog.sense_offset_f,
    )  # fmt: skip
    plant.drive(np.full(3, round(VOLT / analog.drive_volt_per_count)))
    p, s = plant.params[0], plant.state[0]
    where, shown = [], []
    for k in range(round((REST_S + seconds) * 1e6 / period_us)):
        plant.advance_to((k + 1) * period_us)
        if k * period_us >= REST_S * 1e6:
            where.append(plant.position_m)
            farad = p["sense_chain_noise_f"] * s["sense_chain_noise"] + s["sense_walk_f"]
            farad = farad + p["sense_flicker_f"] * s["sense_flicker"].sum(axis=1) * p["sense_flicker_on"]
            shown.append(farad / p["sense_f_per_m"])
    return np.array(where) * 1e9, np.array(shown) * 1e9


def budget() -> dict[str, tuple[Array, Array]]:
    """Of each noise, by its words: deviation (3,) in nm over 20 s of x, y, z or of the strokes shown; its record."""
    found = {}
    for name, words in MOVES.items():
        position, _ = alone((name,))
        found[words] = (position.std(axis=0), position)
    for name, words in SHOWS.items():
        _, shown = alone((name,))
        found[words] = (shown.std(axis=0), shown)
    together, _ = alone(tuple(MOVES))
    found["all that moves it"] = (together.std(axis=0), together)
    return found


def plain(found: dict[str, tuple[Array, Array]]) -> dict[str, list[str]]:
    """What is kept of the budget."""
    return {
        words: [*(f"{v:.2g}" for v in deviation),
                "seen, of stroke 1, 2, 3" if words in SHOWS.values() else "moves the platform"]
        for words, (deviation, _) in found.items()
    }  # fmt: skip


def draw(found: dict[str, tuple[Array, Array]]) -> None:
    """Amplitude spectra in x: what moves the stage, and what the chain shows of channel 1."""
    figure = sheet(11.0, 4.8, "Noises of the plant lab, each alone: the stage held by 130 V, no feedback")
    panels = figure.subplots(1, 2, sharey=True)
    shown = list(SHOWS.values())
    for panel, names, words in (
        (panels[0], [w for w in MOVES.values() if w != "warming package"], "position in x (nm/√Hz)"),
        (panels[1], shown, "shown in stroke 1 (nm/√Hz)"),
    ):
        for name, colour in zip(names, SERIES, strict=False):
            f, density = signal.welch(found[name][1][:, 0], 5000.0, nperseg=10_000)
            panel.loglog(f[1:], np.sqrt(density[1:]), color=colour, lw=1.0, label=name)
        panel.set(xlim=(1.0, 2500.0), ylim=(1e-6, 1.0))
        panel.axvline(631.0, color=MUTED, lw=0.7, ls=":")
        dress(panel, "frequency (Hz)", words)
        legend(panel, "lower left")
    save(figure, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    noises = budget()
    TABLE.write_text(json.dumps(plain(noises), indent=1) + "\n", encoding="utf-8")
    draw(noises)
