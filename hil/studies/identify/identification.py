"""Identification of a stage in its running loop: the excitation that does it, its response, its modes."""

import importlib.metadata
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes.excitation import Excitation, excitation, tones
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.studies.identify.outside_scale import OutsideScale
from hil.studies.identify.plant_response import PlantResponse, measure_plant
from hil.studies.margins.excited import Tones, at_point, periods_of
from pkxyz_ctrl.config.calibration import Calibration, SenseScale
from pkxyz_ctrl.config.files import digest, plain
from pkxyz_ctrl.design.identification.calibrate import Calibrated, SenseGain, calibrate
from pkxyz_ctrl.design.identification.modal_fit import MODES, ModalFit, fit_modes
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

MAINS_HZ = (50, 60)


@dataclass(frozen=True)
class Identification:
    """What was found, and from what: the setup as it was run, on its point, with its excitation."""

    setup: Setup
    lane: Lane
    kind: Tones
    response: PlantResponse
    modes: ModalFit
    outside: OutsideScale | None = None
    """what an instrument saw, if there was one"""

    @property
    def plant(self) -> str:
        """What was identified, by name."""
        return f"device on {self.setup.bus.name}" if self.lane == Lane.WALL else self.setup.plant.name

    @property
    def chain_gain(self) -> tuple[Array, Array]:
        """(3,) sense gain times comb gain over mass of each chain, relative to the stage file,
        and its standard error."""
        stage, analog = Stage(self.setup.stage), self.setup.bus.analog
        position = stage.forward_kinematics(self.response.strokes_m)
        drawn = np.diag(stage.jacobian(position) @ stage.pulls(position).T) * stage.force_gain_n_per_v2 / stage.mass_kg
        drawn = drawn * stage.sense_gradient_f_per_m / analog.sense_farad_per_count
        found = self.modes
        return np.diag(found.acceleration_gain) / drawn, np.diag(found.acceleration_gain_standard_error) / drawn

    @property
    def comb_gain(self) -> tuple[Array, Array] | None:
        """(3,) comb gains relative to the stage file, if its mass is right, and their standard errors; None
        without an outside reference.
        """
        if self.outside is None:
            return None
        product, error = self.chain_gain
        gain, relative = (
            product / self.outside.sense_gain,
            np.hypot(error / product, self.outside.standard_error / self.outside.sense_gain),
        )
        return gain, gain * relative

    @cached_property
    def calibrated(self) -> Calibrated:
        """The stage's calibration, by the drawing: not only by the file that was run, which may have one of before."""
        scale = 1.0 if self.outside is None else self.outside.sense_gain
        return calibrate(
            self.setup.stage,
            self.response.strokes_m / scale,
            self.modes,
            self.setup.bus.analog.sense_farad_per_count,
            self._sense_gain,
        )

    @property
    def _sense_gain(self) -> SenseGain:
        """By the instrument outside, else as the file that was run has it."""
        before = self.setup.stage.calibration or Calibration()
        gain, known = np.array(before.sense_gain), before.standard_error
        error = np.zeros(3) if known is None else np.array(known.sense_gain)
        if self.outside is None:
            return SenseGain(gain, error)
        return SenseGain(gain * self.outside.sense_gain, gain * self.outside.standard_error)

    @property
    def sense_scale(self) -> SenseScale:
        """Where the calibration's metres come from."""
        if self.outside is not None:
            return "instrument"
        before = self.setup.stage.calibration
        if before is not None and before.measured_by is not None and not self._sense_gain.assumed:
            return before.measured_by.sense_scale
        return "reciprocity" if self.calibrated.differ else "drawing"

    @property
    def not_known(self) -> str:
        """What the calibration leaves open."""
        scale = [] if self.sense_scale == "instrument" else [SCALE_NOT_KNOWN]
        return "; ".join([*scale, MASS_NOT_KNOWN, AMPLIFIER_NOT_KNOWN])

    @property
    def drawn_hz(self) -> Array:
        """(3,) modes of the stage file at that point, under the forces that hold it."""
        return modes_hz(self.setup, self.response.strokes_m)


def modes_hz(setup: Setup, strokes_m: Array) -> Array:
    """Natural frequencies (3,) in ascending order by the stage file, about a point, under the forces that hold it."""
    stage = Stage(setup.stage)
    held = loop_plant(stage, setup.bus, strokes_m).stiffness_n_per_m
    return np.asarray(np.sqrt(np.linalg.eigvalsh(held) / stage.mass_kg) / (2.0 * np.pi))


def exciting(setup: Setup, strokes_m: Array, lane: Lane, kind: Tones, amplitude_m: float, periods: int) -> Excitation:
    """All tones at once in periods of 1 s, or, in periods of 0.1 s, one after another; many of them about the modes.
    None lies on a line of the mains, which is alike in all periods and so would pass for an answer.
    """
    seconds, measured = periods_of(kind, lane, periods)
    count, lowest, near = (120, math.ceil(5 * seconds), 60) if kind == "multisine" else (14, 1, 24)
    period_ticks = round(seconds / setup.bus.period_s)
    hz = modes_hz(setup, strokes_m)
    about = np.round(np.linspace(0.85 * hz.min(), 1.15 * hz.max(), near) * seconds).astype(np.int64)
    bins = np.unique(np.r_[tones(period_ticks, count, lowest), about])
    off_mains = np.all([np.round(bins / seconds) % mains_hz != 0 for mains_hz in MAINS_HZ], axis=0)
    bins = bins[(bins < period_ticks // 2) & off_mains]
    return excitation(
        kind, bins, period_ticks=period_ticks, periods=measured, amplitude_m=amplitude_m, first_tick=0, seed=setup.seed
    )


def identify(
    setup: Setup,
    strokes_m: Array,
    lane: Lane,
    *,
    kind: Tones = "multisine",
    amplitude_m: float = 5e-9,
    periods: int = 6,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], object] = lambda words: None,
) -> Identification:
    """Excite the loop of a setup about the position of ``strokes_m`` (3,) and fit the modes. Raises
    ``MeasurementError`` where the loop opens, ``FitError`` where the response doesn't tell the modes.
    """
    run = at_point(setup, strokes_m, exciting(setup, strokes_m, lane, kind, amplitude_m, periods))
    response = measure_plant(run, lane, on_progress, say)
    modes = fit_modes(
        response.frequency_hz,
        response.drive_v2,
        response.sense_count,
        response.noise_count,
        period_s=response.period_s,
        delay_periods=response.delay_periods,
        start_hz=modes_hz(run, strokes_m),
        start_damping=0.5 / Stage(setup.stage).quality_factor,
    )
    return Identification(run, lane, kind, response, modes)


def provenance(found: Identification) -> dict[str, Any]:
    """What decides about the result, with a digest of all of it: equal digest, equal bits. On a real bus, whose device
    no file describes, what it answered stands for it.
    """
    setup, added = found.setup, found.setup.excitation
    assert added is not None
    simulated, response = found.lane != Lane.WALL, found.response
    device = setup.plant.model_dump(mode="json") if simulated else sha256(response.sense_count.tobytes()).hexdigest()
    inputs = {
        "stage": plain(setup.stage), "plant": device, "bus": plain(setup.bus),
        "controller": plain(setup.controller), "seed": setup.seed, "tones": found.kind,
        "bins": [p.bins.tolist() for p in added.passages], "period_ticks": added.period_ticks,
        "periods": added.periods, "amplitude_m": added.amplitude_m,
        "strokes_m": [float(q) for q in response.strokes_m],
    }  # fmt: skip
    return {
        "stage": setup.stage.name, "plant": found.plant, "controller": setup.controller.name,
        "bus": setup.bus.name, "lane": found.lane, "seed": setup.seed, "tones": found.kind,
        "amplitude_nm": added.amplitude_m * 1e9, "periods": added.periods, "digest": digest(inputs),
        "versions": {name: importlib.metadata.version(name) for name in ("pkxyz-ctrl", "numpy", "scipy")},
    }  # fmt: skip


def as_json(found: Identification) -> dict[str, Any]:
    """Plain data of all that was found, with standard errors."""
    modes, response, zero = found.modes, found.response, found.response.zero
    return provenance(found) | {
        "strokes_um": _list(response.strokes_m * 1e6),
        "voltage_v": _list(np.sqrt(response.mean_v2)),
        "modes": [
            {
                "frequency_hz": float(modes.frequency_hz[i]),
                "frequency_error_hz": float(modes.frequency_standard_error_hz[i]),
                "drawn_hz": float(found.drawn_hz[i]),
                "damping": float(modes.damping[i]),
                "damping_error": float(modes.damping_standard_error[i]),
                "quality_factor": float(0.5 / modes.damping[i]),
            }
            for i in range(MODES)
        ],
        "static_gain_count_per_v2": [_list(row) for row in modes.static_gain],
        "static_gain_error_count_per_v2": [_list(row) for row in modes.static_gain_standard_error],
        "sense_zero": {
            "offset_f": _list(zero.offset_f),
            "offset_count": _list(zero.offset_count),
            "error_f": _list(zero.standard_error_f),
            "samples": zero.samples,
        },
        "sense_chain": {"corner_hz": modes.sense_corner_hz, "corner_error_hz": modes.sense_corner_standard_error_hz},
        "fit": {
            "chi_square": modes.chi_square,
            "noise_alone": modes.noise_alone,
            "pole_pairs": int(modes.apart.sum()),
            "tones": len(response.frequency_hz),
            "missed_ticks": response.missed_ticks,
            "lowest_hz": modes.used_hz[0],
            "highest_hz": modes.used_hz[1],
            "least_coherence": float(response.coherence[response.frequency_hz <= modes.used_hz[1]].min()),
        },
        "chain_gain": _list(found.chain_gain[0]),
        "chain_gain_error": _list(found.chain_gain[1]),
        "calibration": _calibration_data(found),
        "known_from_inside": KNOWN,
        "not_known_from_inside": NOT_KNOWN,
        "reference": None if found.outside is None else _outside_data(found),
    }


def _outside_data(found: Identification) -> dict[str, Any]:
    outside, comb = found.outside, found.comb_gain
    assert outside is not None
    assert comb is not None
    stage = Stage(found.setup.stage)
    return {
        "points": outside.points,
        "residual_nm": outside.residual_m * 1e9,
        "origin_um": _list(outside.origin_m * 1e6),
        "sense_gain": _list(outside.sense_gain),
        "sense_gain_error": _list(outside.standard_error),
        "sense_f_per_m": _list(stage.sense_gradient_f_per_m * outside.sense_gain),
        "comb_gain": _list(comb[0]),
        "comb_gain_error": _list(comb[1]),
        "comb_n_per_v2": _list(stage.force_gain_n_per_v2 * comb[0]),
        "assumed_mass_kg": stage.mass_kg,
    }


def _calibration_data(found: Identification) -> dict[str, Any]:
    calibrated, reciprocal = found.calibrated, found.calibrated.reciprocal
    return plain(calibrated.calibration) | {
        "chi_square": calibrated.chi_square,
        "reciprocal_sense_gain": _list(reciprocal.gain),
        "reciprocal_sense_gain_error": _list(reciprocal.error),
        "sense_gains_differ": calibrated.differ,
        "sense_scale": found.sense_scale,
        "not_known": found.not_known,
    }


KNOWN = (
    "offsets, resonances, dampings, delay, counts per V^2, and of each chain sense gain times comb gain over mass; "
    "springs over mass; ratios of the sense gains, by reciprocity"
)
SCALE_NOT_KNOWN = (
    "metres per count, one factor for all chains, with the newtons per V^2 in inverse proportion: the mean sense gain "
    "is the drawing's; --reference FILE.csv of an instrument outside tells"
)
MASS_NOT_KNOWN = "the mass, and so the scale of all forces and stiffnesses, which is the drawing's: nothing moves by it"
AMPLIFIER_NOT_KNOWN = (
    "the amplifier's pole, which is the drawing's: at the samples it looks like delay, which has what it lags more"
)
"""A pole that dies within a period adds to the samples' response what B, C and D of ``modal_fit`` are free to be."""
NOT_KNOWN = "metres per count and newtons per V^2 by themselves; --reference FILE.csv of an instrument outside tells"


def _list(values: Array) -> list[float]:
    return [float(v) for v in values]


def response_csv(found: Identification) -> str:
    """The measured response as a table: a line for each tone and entry."""
    r, fitted = found.response, found.modes.response(found.response.frequency_hz)
    lines = [
        "frequency_hz,chain,comb,real_count_per_v2,imag_count_per_v2,standard_error_count_per_v2,coherence,fit_real,fit_imag"
    ]
    for k, f in enumerate(r.frequency_hz):
        for i in range(3):
            for j in range(3):
                p, m = r.p[k, i, j], fitted[k, i, j]
                lines.append(
                    f"{f:.6g},{i + 1},{j + 1},{p.real:.8g},{p.imag:.8g},{r.standard_error[k, i, j]:.4g},"
                    f"{r.coherence[k, i]:.6f},{m.real:.8g},{m.imag:.8g}"
                )
    return "\n".join(lines) + "\n"
