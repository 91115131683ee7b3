"""Faults of sense channels, amplifier channels and mechanics: between the node and what it is wired to."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hil.faults import channels as faulty
from hil.faults.channels import CHANNEL, DICE, amplified, dice_of, sensed
from hil.faults.fault import Fault
from hil.plant.on_bus import PlantOnBus
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.config.bus import BusConfig
from sim.plant import Plant

FAMILIES = ("sense", "amplifier", "plant")

_DICE_SOURCE = 1 << 16  # of the seed's streams: none of the plant's own
_STIFFNESSES = ("leaf_n_per_m", "crank_hinge_nm", "link_hinge_nm")


class FaultyPlant(PlantOnBus):
    """A plant with faults, each for its time after the first sample.

    ``channels`` (n,) of ``CHANNEL`` are its faulty channels at present, in the order in which they began, and ``dice``
    (1,) of ``DICE`` what they roll.
    """

    def __init__(self, plant: Plant, faults: Sequence[Fault], bus: BusConfig, seed: int) -> None:
        super().__init__(plant)
        self._analog = bus.analog
        self._period_us = bus.period_us
        self._t_us = -1  # of the present sample
        faults = [f for f in faults if f.kind != "trip"]
        self._to_come = sorted(faults, key=lambda f: f.at_us, reverse=True)
        self._on: list[Fault] = []
        self._change_us: float = min((f.at_us for f in self._to_come), default=math.inf)
        self.channels = np.zeros(_most_at_once([f for f in faults if _has_channel(f)]), CHANNEL)
        self.dice = dice_of(seed, _DICE_SOURCE)
        self._broken: list[Fault] = []  # those that ``channels`` stand for
        self._whole = {name: plant.params[name].copy() for name in _STIFFNESSES}
        self._offset_v = plant.params["amplifier_offset_v"].copy()
        self._amplified = direct(amplified, self.channels, 0, 0, 0, 0)
        self._sensed = direct(sensed, self.channels, self.dice, 0, 0, 0)

    def exchange(self, t_us: int, counts: Counts | None, *, sample: bool) -> Counts:
        """Time passes for the faults with each sample, and in ``look``."""
        if counts is not None:
            self.commanded = counts
        if not sample:
            return super().exchange(t_us, self._on_converters(counts), sample=False)
        changed = self._pass_time(t_us, t_us if self.origin_us is None else self.origin_us, counts)
        a, b, c = super().exchange(t_us, changed, sample=True)
        return self._sensed(self.channels, self.dice, a, b, c) if self._on else (a, b, c)

    @property
    def quiet_until_us(self) -> int | None:
        """When a fault begins or ends next."""
        if self.origin_us is None:
            return 0
        return None if math.isinf(self._change_us) else self.origin_us + int(self._change_us)

    @property
    def is_disturbed(self) -> bool:
        """Whether a fault is on."""
        return bool(self._on)

    def look(self, t_us: int) -> None:
        """Without a sample, too, time passes for the faults."""
        self._see(t_us, None if self.origin_us is None else self._pass_time(t_us, self.origin_us, None))

    def _pass_time(self, t_us: int, origin_us: int, counts: Counts | None) -> Counts | None:
        """What the converters take now. A fault that begins or ends leaves the time before it as it was."""
        self._t_us = t_us - origin_us
        if self._t_us >= self._change_us:
            super().exchange(t_us, self._on_converters(counts), sample=False)
            self._change()
            counts = self.commanded
        return self._on_converters(self.commanded if self._on else counts)

    def _on_converters(self, counts: Counts | None) -> Counts | None:
        if not self._on or counts is None:
            return counts
        out: Counts = self._amplified(self.channels, self._t_us, *counts)
        return out

    def _change(self) -> None:
        """Faults begin or end with this sample."""
        self._on = [f for f in self._on if f.is_on(self._t_us)]
        while self._to_come and self._to_come[-1].at_us <= self._t_us:
            fault = self._to_come.pop()
            if fault.is_on(self._t_us):
                self._on.append(fault)
        self._rewire([f for f in self._on if _has_channel(f)])
        changes = [float(f.end_us) for f in self._on if f.end_us is not None]
        self._change_us = min([*changes, *(float(f.at_us) for f in self._to_come[-1:])], default=math.inf)
        offset_v = self._offset_v.copy()
        for fault in self._on:
            if fault.family == "amplifier" and fault.kind == "offset":
                offset_v[0, fault.channel] += fault["offset_v"]
        self.plant.params["amplifier_offset_v"] = offset_v
        self._disturb()

    def _rewire(self, broken: list[Fault]) -> None:
        """``channels`` become those of ``broken``: what goes on keeps its memory."""
        before = {id(fault): record for fault, record in zip(self._broken, self.channels.copy(), strict=False)}
        self.channels["kind"] = 0
        for place, fault in enumerate(broken):
            kept = before.get(id(fault))
            self.channels[place] = self._begun(fault)[0] if kept is None else kept
        self._broken = broken

    def _begun(self, fault: Fault) -> NDArray[np.void]:
        """(1,) of ``CHANNEL``, at the beginning of a fault."""
        channel = np.zeros(1, CHANNEL)
        numbers = self._amplifier_numbers(fault) if fault.family == "amplifier" else self._sense_numbers(fault)
        channel["place"], channel["t_us"] = fault.channel, self._t_us
        channel["kind"], channel["first"], channel["second"], channel["count"] = numbers
        return channel

    def _amplifier_numbers(self, fault: Fault) -> tuple[int, float, float, float]:
        volt_per_count = self._analog.drive_volt_per_count
        held = float(self.plant.voltage_v[fault.channel]) / volt_per_count
        match fault.kind:
            case "stuck":
                return faulty.HELD, held, 0.0, 0.0
            case "dead":
                return faulty.HELD, 0.0, 0.0, 0.0
            case "saturated":
                return faulty.HIGHEST, fault["voltage_v"] / volt_per_count, 0.0, 0.0
        return faulty.SLEWING, fault["slew_v_per_s"] / volt_per_count * 1e-6, 0.0, held  # slew_collapse

    def _sense_numbers(self, fault: Fault) -> tuple[int, float, float, float]:
        p = self.plant.params[0]
        per_m = float(p["sense_f_per_m"][fault.channel] / p["count_f"])
        match fault.kind:
            case "off":
                return faulty.LOW, 0.0, 0.0, 0.0
            case "stuck":
                return faulty.STUCK, 0.0, 0.0, 0.0
            case "garbage":
                return faulty.GARBAGE, 0.0, 0.0, 0.0
            case "wrong_gain":
                at_rest = float((p["sense_rest_f"] - p["count_zero_f"]) / p["count_f"])
                return faulty.SCALED, fault["gain"], at_rest, 0.0
            case "offset":
                return faulty.ADDED, per_m * fault["offset_m"], 0.0, 0.0
            case "slow":
                share = 1.0 - math.exp(-2e-6 * math.pi * fault["corner_hz"] * self._period_us)
                return faulty.LAGGING, share, 0.0, 0.0
            case "delayed":
                return faulty.DELAYED, float(round(fault["samples"])), 0.0, 0.0
            case "intermittent":
                return faulty.LOOSE, fault["probability"], 0.0, 0.0
        return faulty.NOISY, per_m * fault["sigma_m"], 0.0, 0.0  # noise_burst

    def _disturb(self) -> None:
        """Forces and stiffness from this sample on."""
        force_n = [0.0, 0.0, 0.0]
        factor = 1.0
        for fault in self._on:
            if fault.family != "plant":
                continue
            if fault.kind == "stiffness":
                factor *= fault["factor"]
            else:
                force_n[0 if fault.kind == "shock" else 2] += fault["force_n"]
        self.plant.external_force_n = force_n
        for name, value in self._whole.items():
            self.plant.params[name] = factor * value


def channels_of(plant: PlantOnBus) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """``channels`` and ``dice`` of a plant; none for one that can have no faults."""
    if isinstance(plant, FaultyPlant):
        return plant.channels, plant.dice
    return np.zeros(0, CHANNEL), np.zeros(1, DICE)


def _has_channel(fault: Fault) -> bool:
    """Whether it changes counts on their way; an offset is added to the volts."""
    return fault.family == "sense" or (fault.family == "amplifier" and fault.kind != "offset")


def _most_at_once(faults: Sequence[Fault]) -> int:
    changes = sorted([(f.at_us, 1) for f in faults] + [(f.end_us, -1) for f in faults if f.end_us is not None])
    now = most = 0
    for _, change in changes:
        now += change
        most = max(most, now)
    return most
