"""Sampled devices in a closed loop: margins, and the error of a scenario on the fast lane.

Device k of this part lies on wafer k, so that the devices are independent of each other, or with ``per_wafer`` others
on wafer k // per_wafer, all over it. Each is run under the law as shipped, which knows the drawing only, and if asked
also under a law designed for

- what `pkxyz identify` finds of it, from inside and with an instrument outside (``identified``);
- what an identification without error would find: springs, combs, sense combs and damping, by the drawing's mass.

Links are taken to be alike (their mean), which the plant's mechanism has them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.abreast import batch
from hil.lanes import in_process as lanes
from hil.lanes import many
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.runs.metrics import Metrics
from hil.runs.scenario import Scenario, resolve
from hil.studies.identify.identification import identify
from hil.studies.wafer.identified import deviates, from_inside, with_instrument
from hil.studies.wafer.study import WaferStudy, spread_die, within
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.identification.modal_fit import FitError, ModalFit
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_in_parts
from pkxyz_ctrl.design.margins.margins import peak_and_rejection
from pkxyz_ctrl.design.model.loop_plant import Perturbation, loop_plant
from pkxyz_ctrl.fabrication.devices import Devices
from pkxyz_ctrl.fabrication.figures import figures
from pkxyz_ctrl.fabrication.process import SOURCES, Spread
from pkxyz_ctrl.fabrication.wafer import Sampled, dies_per_wafer, sample_devices, sample_numbered, sizes
from pkxyz_ctrl.stage import Stage
from sim.config import Device, PlantConfig

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

PART_DEVICES = 16
PARTS_TOGETHER = 16
WORTH_MAKING = 20_000
"""Runs that are faster side by side by more than that takes to be compiled."""
LAWS = ("shipped", "identified", "instrument", "known")
LOOP_FIGURES: dict[str, str] = {
    "peak_s": "largest singular value of the sensitivity, in the middle of the strokes; infinite: unstable",
    "rejection_hz": "up to which |S| < -3 dB there; 0: unstable",
    "error_nm": "RMS error of the scenario's scan, of the worst axis; infinite: ended in a fault",
    "error_about_mean_nm": "the same about its own mean, which an offset shifts",
}
"""Of each law: columns are ``shipped.peak_s`` and so on."""
_MARGINS = ("peak_s", "rejection_hz")
NO_LOOP = {name: 0.0 if name == "rejection_hz" else math.inf for name in LOOP_FIGURES}
"""Of a device for which there is no law."""


@dataclass(frozen=True)
class ClosedLoops:
    """What is asked of devices in a loop. The scenario's stage is the drawing."""

    wafers: WaferStudy
    scenario: Scenario
    known: bool
    """also under a law designed for each device as it is"""
    identified: bool = False
    """also under laws designed for what an identification finds of it, from inside and with an instrument"""
    per_wafer: int = 1
    """devices of each wafer"""

    def __post_init__(self) -> None:
        dies = dies_per_wafer(self.wafers.process)
        if not 1 <= self.per_wafer <= dies:
            raise ConfigError(
                f"{self.wafers.process.name}: has {dies} devices a wafer; {self.per_wafer} were asked for"
            )
        names = [f"{law}.{figure}" for law in LAWS for figure in LOOP_FIGURES]
        unknown = [name for name in self.wafers.process.closed_loop if name not in names]
        if unknown:
            raise ConfigError(
                f"{self.wafers.process.name}: closed_loop.{unknown[0]!r}: no such figure; known: {', '.join(names)}"
            )

    def digest(self) -> str:
        """Of all that decides about a device's loop, its number apart."""
        return config.digest({
            "wafers": self.wafers.digest(), "scenario": resolve(self.scenario), "laws": list(self.laws),
            "per_wafer": self.per_wafer, "figures": list(LOOP_FIGURES),
        })  # fmt: skip

    @property
    def together(self) -> int:
        """Parts that a worker is handed at most: some seconds of work."""
        return PARTS_TOGETHER

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the figures of the laws that are run."""
        return tuple(f"{law}.{figure}" for law in self.laws for figure in LOOP_FIGURES)

    @property
    def verdict_columns(self) -> tuple[str, ...]:
        """Columns of verdicts: each requirement of the laws that are run, and all of each law."""
        asked = (name for name in self.wafers.process.closed_loop if name.partition(".")[0] in self.laws)
        return (*(f"ok.{name}" for name in asked), *(f"ok.{law}" for law in self.laws))

    @property
    def laws(self) -> tuple[str, ...]:
        """Those of ``LAWS`` that are run."""
        asked = {"identified": self.identified, "instrument": self.identified, "known": self.known}
        return tuple(law for law in LAWS if asked.get(law, True))

    @cached_property
    def mean_modes(self) -> ModalFit:
        """What an identification fits to the process' mean device, run on the fast lane under the scenario's law."""
        of = self.wafers
        still = {name: Spread(mean=getattr(of.process, name).mean) for name in SOURCES}
        mean = replace(of, process=of.process.model_copy(update=still))
        truth = Truth(of.stage, of.as_drawn, mean.made(sample_devices(mean.process, of.seed, 0, 1)))
        setup = truth.setup(self._as_shipped)
        strokes = np.full(3, 0.5 * (of.stage.limits.stroke_min_m + of.stage.limits.stroke_max_m))
        return identify(setup, strokes, Lane.FAST).modes

    def prepare(self, devices: int, tell: Callable[[str], None]) -> None:
        """What so many devices are worth: code that runs some of them side by side, where the machine has vectors."""
        if devices * len(self.laws) >= WORTH_MAKING:
            batch.prepare(own_laws=False, tell=tell)
            if len(self.laws) > 1:
                batch.prepare(own_laws=True, tell=tell)

    def drawn_peak_s(self) -> float:
        """Ms of the drawing as drawn under the law as shipped."""
        drawn = self.wafers.as_drawn
        return Truth(self.wafers.stage, drawn, drawn).margins(self._as_shipped)[0]

    def numbers(self, part: int) -> NDArray[np.int64]:
        """Numbers of the devices of a part: ``per_wafer`` on each wafer, evenly over its dies."""
        wafer, nth = np.divmod(part * PART_DEVICES + np.arange(PART_DEVICES), self.per_wafer)
        dies = dies_per_wafer(self.wafers.process)
        return np.asarray(wafer * dies + (spread_die(wafer, dies) + nth * dies // self.per_wafer) % dies)

    def part(self, number: int) -> dict[str, NDArray[Any]]:
        """All that is kept of the devices of a part: ``device`` is k, ``number`` what it has in the wafers' table."""
        numbers = self.numbers(number)
        first = number * PART_DEVICES
        return {
            "device": np.arange(first, first + PART_DEVICES),
            "number": numbers,
            "wafer": numbers // dies_per_wafer(self.wafers.process),
            **self.judged(sample_numbered(self.wafers.process, self.wafers.seed, numbers)),
        }

    def judged(self, sampled: Sampled) -> dict[str, NDArray[Any]]:
        """Figures of devices as columns, and of each requirement whether it is met."""
        rows = self.sampled(sampled)
        found = {name: np.array([row[name] for row in rows], dtype=np.float64) for name in rows[0]}
        return {**found, **self.verdicts(found)}

    def verdicts(self, found: Mapping[str, Array]) -> dict[str, NDArray[np.bool_]]:
        """``ok.NAME`` for each requirement on the loop whose law was run; ``ok.LAW``: all of a law's and all of the
        device's own.
        """
        bounds = {k: b for k, b in self.wafers.process.closed_loop.items() if k.partition(".")[0] in self.laws}
        each = {f"ok.{name}": within(found[name], b.min, b.max) for name, b in bounds.items()}
        own = found["own"] > 0.5
        return each | {
            f"ok.{law}": np.logical_and.reduce([own, *(each[f"ok.{n}"] for n in bounds if n.startswith(f"{law}."))])
            for law in self.laws
        }

    def device(self, number: int) -> dict[str, float]:
        """``devices`` of one."""
        return self.devices(np.array([number]))[0]

    def devices(self, numbers: NDArray[np.int64]) -> list[dict[str, float]]:
        """``sampled`` of devices by their numbers (n,)."""
        return self.sampled(sample_numbered(self.wafers.process, self.wafers.seed, numbers))

    def sampled(self, sampled: Sampled) -> list[dict[str, float]]:
        """Figures of devices, their sizes (of the chains, the mean), and whether each meets what is asked of it without
        a loop (``own``: 1 or 0). Their numbers seed what is random in a run.
        """
        of, numbers = self.wafers, sampled.device
        size, made = sizes(of.process, sampled), of.made(sampled)
        meets = of.verdicts(figures(of.stage, of.as_drawn, made))["ok"]
        truths = [Truth(of.stage, of.as_drawn, made.take(np.array([n]))) for n in range(len(numbers))]
        means = {name: size[name].mean(axis=1) for name in SOURCES}
        found = [
            {"own": float(meets[n]), **{name: float(mean[n]) for name, mean in means.items()}}
            for n in range(len(numbers))
        ]
        for law in self.laws:
            for row, values in zip(found, self._run(truths, numbers.tolist(), law), strict=True):
                row |= {f"{law}.{name}": value for name, value in values.items()}
        return found

    @cached_property
    def _as_shipped(self) -> Setup:
        """Of the scenario's own plant and device."""
        return self.scenario.setup()

    def _believed(self, truth: "Truth", number: int, law: str) -> StageConfig:
        """The stage file that a law is designed for."""
        if law == "known":
            return truth.stage
        find = from_inside if law == "identified" else with_instrument
        farad_per_count, rng = self.scenario.bus.analog.sense_farad_per_count, deviates(self.wafers.seed, number)
        measured = find(self.wafers.stage, truth.itself, self.mean_modes, farad_per_count, rng)
        return self.wafers.stage.model_copy(update={"calibration": measured})

    def _setup(self, truth: "Truth", number: int, law: str) -> Setup | None:
        """A device under a law; None where there is no law for it, as it is refused as no device of this drawing."""
        setup = replace(truth.setup(self._as_shipped), seed=number)
        if law == "shipped":
            setup.__dict__["law"] = self._as_shipped.law
            return setup
        try:
            setup = replace(setup, stage=self._believed(truth, number, law))
        except FitError:
            return None
        # of no use to anybody else: not to be kept with the shipped ones
        setup.__dict__["law"] = design_law(Stage(setup.stage), setup.controller, setup.bus, autostart=True)
        return setup

    def _run(self, truths: "list[Truth]", numbers: list[int], law: str) -> list[dict[str, float]]:
        """``LOOP_FIGURES`` of each device under a law."""
        setups = [self._setup(truth, number, law) for truth, number in zip(truths, numbers, strict=True)]
        errors = iter(scan_errors_nm([setup for setup in setups if setup is not None]))
        return [
            dict(NO_LOOP) if setup is None else dict(zip(_MARGINS, truth.margins(setup), strict=True)) | next(errors)
            for truth, setup in zip(truths, setups, strict=True)
        ]


def scan_errors_nm(setups: Sequence[Setup]) -> list[dict[str, float]]:
    """RMS error of the scan of each run, of the worst axis; infinite where it ended in a fault. Runs that differ in
    device and law alone, of laws of one kind.
    """
    if not setups or not many.can_run(setups[0]):
        return [_scan_error_nm(setup) for setup in setups]
    alike = all(setup.law is setups[0].law for setup in setups)
    laws = setups[0].law if alike else many.joined([setup.law for setup in setups])
    laws.flags.writeable = False
    scanned = batch.scan_errors(setups[0], laws, [setup.new_plant() for setup in setups])
    ended = (scanned["faulted"] != 0) | (scanned["ticks"] == 0)
    errors = (many.rms_m(scanned), many.deviation_m(scanned))
    rms_nm, deviation_nm = (np.where(ended, math.inf, 1e9 * e.max(axis=1)) for e in errors)
    return [{"error_nm": float(e), "error_about_mean_nm": float(d)} for e, d in zip(rms_nm, deviation_nm, strict=True)]


def _scan_error_nm(setup: Setup) -> dict[str, float]:
    """The same of one run, whatever it is."""
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    ran = lanes.run(setup, Lane.FAST, on_block=metrics.update)
    seen = metrics.figures()

    def worst(values: Mapping[str, float] | None) -> float:
        return math.inf if ran.faults or values is None else max(values.values())

    return {"error_nm": worst(seen.rms_error_nm), "error_about_mean_nm": worst(seen.error_deviation_nm)}


class Truth:
    """One device as stage file, plant and linear plant have it."""

    def __init__(self, drawing: StageConfig, drawn: Devices, made: Devices) -> None:
        self._drawing = drawing
        self._mass = float(made.mass_kg[0] / drawn.mass_kg[0])
        self._slider = made.slider_n_per_m[0] / drawn.slider_n_per_m[0]
        self._crank = made.crank_n_m_per_rad[0] / drawn.crank_n_m_per_rad[0]
        self._link = float(made.link_n_m_per_rad[0] / drawn.link_n_m_per_rad[0])
        self._comb, self._sense = made.comb_gain[0], made.sense_gain[0]
        self._quality = float(made.quality_factor[0])
        self._height_m, self._projection_m = float(made.height_m[0]), float(made.projection_m[0].mean())

    @property
    def stage(self) -> StageConfig:
        """The drawing with what an identification finds: forces and stiffnesses go with the drawing's mass."""
        return self._drawing.model_copy(
            update={
                "calibration": Calibration(
                    comb_gain=_triple(self._comb / self._mass),
                    sense_gain=_triple(self._sense),
                    slider_stiffness=_triple(self._slider / self._mass),
                    crank_stiffness=_triple(self._crank / self._mass),
                    link_stiffness=self._link / self._mass,
                    quality_factor=self._quality,
                )
            }
        )

    @property
    def itself(self) -> StageConfig:
        """The same with links as they were made: all of the device, by the drawing's mass."""
        return self.stage.model_copy(update={"geometry": self._drawing.geometry.model_copy(update=self._links())})

    def setup(self, shipped: Setup) -> Setup:
        """A run on this device in place of its own."""
        return replace(shipped, plant=self.plant(shipped.plant), device=self.device(shipped.device))

    def device(self, drawn: Device) -> Device:
        """Links as they were made, for the plant."""
        return drawn.model_copy(update={"geometry": drawn.geometry.model_copy(update=self._links())})

    def plant(self, plant: PlantConfig) -> PlantConfig:
        """A plant with this device's errors in place of its own of these kinds."""
        own: dict[str, dict[str, Any]] = {
            "stiffness_mismatch": {
                "leaf": _triple(self._slider - 1.0),
                "crank_hinge": _triple(self._crank - 1.0),
                "link_hinge": (self._link - 1.0,) * 3,
            },
            "mass_error": {"relative": self._mass - 1.0},
            "comb_mismatch": {"relative": _triple(self._comb - 1.0)},
            "sense_gain": {"relative": _triple(self._sense - 1.0)},
            "damping": {"quality_factor": self._quality},
        }
        sections = {name: getattr(plant, name).model_copy(update={"on": True, **of}) for name, of in own.items()}
        return plant.model_copy(update=sections)

    def margins(self, setup: Setup) -> tuple[float, float]:
        """Ms of this device under a setup's law and how far it rejects, in Hz, in the middle of the strokes, sensed and
        pulled as that law has it.
        """
        limits = self._drawing.limits
        strokes = np.full(3, 0.5 * (limits.stroke_min_m + limits.stroke_max_m))
        belief = _stage_of(setup.stage)
        itself = Stage(self.itself)
        believed = setup.stage.calibration or Calibration()
        pull = self._comb / self._mass / np.array(believed.comb_gain)
        seen = self._sense / np.array(believed.sense_gain)
        plant = loop_plant(itself, setup.bus, strokes, Perturbation(comb_gain=_triple(pull - 1.0)))
        jacobian = itself.jacobian(itself.forward_kinematics(strokes))
        scale = np.linalg.solve(jacobian, seen[:, None] * jacobian)
        holds, thinks = (s.holding_forces(s.forward_kinematics(strokes)) for s in (itself, belief))
        # by how much the controller is off about the forces that hold the point
        law = law_in_parts(belief, setup.law, strokes, Perturbation(comb_gain=_triple(pull * thinks / holds - 1.0)))
        return peak_and_rejection(replace(plant, c=scale @ plant.c), law)

    def _links(self) -> dict[str, float | None]:
        return {
            "link_projection_rest_m": self._projection_m,
            "link_height_rest_m": self._height_m,
            "link_length_m": None,
            "elevation_rest_rad": None,
        }


@lru_cache(maxsize=4)
def _stage_of(config: StageConfig) -> Stage:
    """The drawing's is asked for with each device."""
    return Stage(config)


def _triple(values: Array) -> Triple:
    return float(values[0]), float(values[1]), float(values[2])
