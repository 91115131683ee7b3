"""Faults of sense channels, amplifier channels and mechanics: between the node and what it is wired to."""

import math
import random
from collections import deque
from collections.abc import Callable, Sequence

from hil.faults.fault import Fault
from hil.plant.on_bus import PlantOnBus
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.config.bus import BusConfig
from sim.plant import Plant

FAMILIES = ("sense", "amplifier", "plant")

Channel = Callable[[float, int], float]
"""What a channel makes of a value at t_us; a new one each time that its fault begins."""

_LOW, _HIGH = -32768, 32767
_STIFFNESSES = ("leaf_n_per_m", "crank_hinge_nm", "link_hinge_nm")


class FaultyPlant(PlantOnBus):
    """A plant with faults, each for its time after the first sample."""

    def __init__(self, plant: Plant, faults: Sequence[Fault], bus: BusConfig, seed: int) -> None:
        super().__init__(plant)
        self._analog = bus.analog
        self._period_us = bus.period_us
        self._t_us = -1  # of the present sample
        self._commanded: Counts = (0, 0, 0)
        self._random = random.Random(seed)
        self._to_come = sorted((f for f in faults if f.kind != "trip"), key=lambda f: f.at_us, reverse=True)
        self._on: list[Fault] = []
        self._change_us: float = min((f.at_us for f in self._to_come), default=math.inf)
        self._channels: dict[int, Channel] = {}  # of the faults that are on, by the identity of the fault
        self._whole = {name: plant.params[name].copy() for name in _STIFFNESSES}
        self._offset_v = plant.params["amplifier_offset_v"].copy()

    def exchange(self, t_us: int, counts: Counts | None, *, sample: bool) -> Counts:
        """Time passes for the faults with each sample, and in ``look``."""
        if counts is not None:
            self._commanded = counts
        if not sample:
            return super().exchange(t_us, self._on_converters(counts), sample=False)
        changed = self._pass_time(t_us, t_us if self.origin_us is None else self.origin_us, counts)
        sensed = super().exchange(t_us, changed, sample=True)
        return self._through_sense(sensed) if self._on else sensed

    def look(self, t_us: int) -> None:
        """Without a sample, too, time passes for the faults."""
        if self.origin_us is not None:
            super().exchange(t_us, self._pass_time(t_us, self.origin_us, None), sample=False)
        super().look(t_us)

    def _pass_time(self, t_us: int, origin_us: int, counts: Counts | None) -> Counts | None:
        """What the converters take now. A fault that begins or ends leaves the time before it as it was."""
        self._t_us = t_us - origin_us
        if self._t_us >= self._change_us:
            super().exchange(t_us, self._on_converters(counts), sample=False)
            self._change()
            counts = self._commanded
        return self._on_converters(self._commanded if self._on else counts)

    def _on_converters(self, counts: Counts | None) -> Counts | None:
        return self._through_amplifier(counts) if self._on and counts is not None else counts

    def _change(self) -> None:
        """Faults begin or end with this sample."""
        for fault in [f for f in self._on if not f.is_on(self._t_us)]:
            self._on.remove(fault)
            del self._channels[id(fault)]
        while self._to_come and self._to_come[-1].at_us <= self._t_us:
            fault = self._to_come.pop()
            if fault.is_on(self._t_us):
                self._on.append(fault)
                self._channels[id(fault)] = (
                    self._begin_sense(fault) if fault.family == "sense" else self._begin_amplifier(fault)
                )
        changes = [float(f.end_us) for f in self._on if f.end_us is not None]
        self._change_us = min([*changes, *(float(f.at_us) for f in self._to_come[-1:])], default=math.inf)
        offset_v = self._offset_v.copy()
        for fault in self._on:
            if fault.family == "amplifier" and fault.kind == "offset":
                offset_v[0, fault.channel] += fault["offset_v"]
        self.plant.params["amplifier_offset_v"] = offset_v
        self._disturb()

    def _through_amplifier(self, counts: Counts) -> Counts:
        out = [float(c) for c in counts]
        for fault in self._on:
            if fault.family == "amplifier":
                out[fault.channel] = self._channels[id(fault)](out[fault.channel], self._t_us)
        return round(out[0]), round(out[1]), round(out[2])

    def _begin_amplifier(self, fault: Fault) -> Channel:
        if fault.family != "amplifier":
            return lambda count, t_us: count
        volt_per_count = self._analog.drive_volt_per_count
        held = self.plant.voltage_v[fault.channel] / volt_per_count
        match fault.kind:
            case "stuck":
                return lambda count, t_us: held
            case "dead":
                return lambda count, t_us: 0.0
            case "saturated":
                highest = fault["voltage_v"] / volt_per_count
                return lambda count, t_us: min(count, highest)
            case "slew_collapse":
                return _Slewing(held, self._t_us, fault["slew_v_per_s"] / volt_per_count * 1e-6)
        return lambda count, t_us: count  # an offset is added to the volts

    def _through_sense(self, counts: Counts) -> Counts:
        out = [float(c) for c in counts]
        for fault in self._on:
            if fault.family == "sense":
                out[fault.channel] = self._channels[id(fault)](out[fault.channel], self._t_us)
        a, b, c = (max(_LOW, min(_HIGH, round(v))) for v in out)
        return a, b, c

    def _begin_sense(self, fault: Fault) -> Channel:
        p = self.plant.params[0]
        per_m = float(p["sense_f_per_m"][fault.channel] / p["count_f"])
        at_rest = float((p["sense_rest_f"] - p["count_zero_f"]) / p["count_f"])
        dice = self._random
        match fault.kind:
            case "off":
                return lambda count, t_us: _LOW
            case "stuck":
                return _Stuck()
            case "garbage":
                return lambda count, t_us: dice.randint(_LOW, _HIGH)
            case "wrong_gain":
                return lambda count, t_us: at_rest + fault["gain"] * (count - at_rest)
            case "offset":
                return lambda count, t_us: count + per_m * fault["offset_m"]
            case "slow":
                return _Lagging(1.0 - math.exp(-2e-6 * math.pi * fault["corner_hz"] * self._period_us))
            case "delayed":
                return _Delaying(round(fault["samples"]))
            case "intermittent":
                return lambda count, t_us: _LOW if dice.random() < fault["probability"] else count
        return lambda count, t_us: count + per_m * dice.gauss(0.0, fault["sigma_m"])  # noise_burst

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


class _Stuck:
    """The first value again and again."""

    def __init__(self) -> None:
        self._count: float | None = None

    def __call__(self, count: float, t_us: int) -> float:
        if self._count is None:
            self._count = count
        return self._count


class _Slewing:
    """An output that moves towards what is commanded by so many counts a microsecond."""

    def __init__(self, count: float, t_us: int, per_us: float) -> None:
        self._count, self._t_us, self._per_us = count, t_us, per_us

    def __call__(self, count: float, t_us: int) -> float:
        reach = self._per_us * (t_us - self._t_us)
        self._t_us = t_us
        self._count += max(-reach, min(reach, count - self._count))
        return self._count


class _Lagging:
    """A first-order filter that takes a share of the way at each sample."""

    def __init__(self, share: float) -> None:
        self._share = share
        self._count: float | None = None

    def __call__(self, count: float, t_us: int) -> float:
        last = count if self._count is None else self._count
        self._count = last + self._share * (count - last)
        return self._count


class _Delaying:
    """The sample of so many samples ago, the oldest known at first."""

    def __init__(self, samples: int) -> None:
        self._held: deque[float] = deque(maxlen=samples + 1)

    def __call__(self, count: float, t_us: int) -> float:
        self._held.append(count)
        return self._held[0]
