"""What may be tuned of each law: one section of a controller file, of which the chosen law's has to be there."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pkxyz_ctrl.config.files import FrozenModel

Positive = Annotated[float, Field(gt=0)]
Row = tuple[float, ...]


class PiNotch(FrozenModel):
    """The commercial baseline: an integrator with a proportional part, behind a notch at each of two frequencies."""

    gain_margin_db: Positive = 6.0
    """on the sampled, delayed plant; sets the gain"""
    integral_time_s: Annotated[float, Field(ge=0)] = 200e-6
    """t_i: proportional over integral gain. Little, as the loop ends below the resonance"""
    notch_damping: Positive = 0.7
    """zeta of the notches' poles: how wide they are"""
    quality_factor: Positive = 20.0
    """of the modes that the notches' zeros stand on"""


class Irc(FrozenModel):
    """Integral resonant control: damping inside, PI outside."""

    feedthrough: float = 3.0
    """-D times the stiffness, above 1, or there are no zeros below the resonance. The literature has 2 for a loop
    without delay; then the damping alone has used up a gain margin of 6 dB
    """
    gain_margin_db: Positive = 6.0
    """of damping and tracking together, at the stage"""
    integral_time_s: Annotated[float, Field(ge=0)] = 100e-6
    """t_i: proportional over integral gain of the tracking law"""


class ShapingWeight(FrozenModel):
    """W(s) = K (w_i / s) (1 + 2 zeta s / w_z + (s / w_z)^2) / (1 + s / w_l) of an axis, K being its stiffness: what the
    open loop shall look like before the synthesis makes it stable. An integrator, zeros near the resonance, a lag.
    """

    integral_hz: Positive
    """w_i / 2 pi: where the shaped plant's gain would pass 1 if it were an integrator alone"""
    zeros_hz: Positive
    """w_z / 2 pi"""
    zeros_damping: Positive
    """zeta"""
    lag_hz: Positive
    """w_l / 2 pi"""


class Hinf(FrozenModel):
    """H-infinity loop shaping after McFarlane and Glover."""

    plane: ShapingWeight
    """of x and of y"""
    z: ShapingWeight
    factor: Annotated[float, Field(gt=1)] = 1.1
    """gamma over the least possible one"""


class Transfer(FrozenModel):
    """Numerator over denominator, coefficients of falling powers of s, or of z for a discrete law. N/m."""

    numerator: Annotated[Row, Field(min_length=1)]
    denominator: Annotated[Row, Field(min_length=1)]


class Matrices(FrozenModel):
    """x' = A x + B e, w = -(C x + D e), or x+ for a discrete law; 3 inputs in m and 3 outputs in N, axes x, y, z."""

    a: tuple[Row, ...]
    b: tuple[Row, ...]
    c: tuple[Row, ...]
    d: tuple[Row, ...]


class Linear(FrozenModel):
    """A law of the user's own, w = -K (y - r): as a transfer function for each axis, or as matrices for all."""

    period_us: Annotated[int, Field(gt=0)] | None = None
    """period of a discrete law, which must be the bus's; none: continuous, and is sampled"""
    method: Literal["tustin", "zoh"] = "tustin"
    """how a continuous law is sampled"""
    axis: tuple[Transfer, ...] = ()
    """one, which serves every axis alike, or three: x, y, z"""
    matrices: Matrices | None = None

    @model_validator(mode="after")
    def _one_description(self) -> Self:
        if (self.matrices is None) == (not self.axis):
            raise ValueError("give the law either by [[linear.axis]] or by [linear.matrices]")
        if len(self.axis) not in (0, 1, 3):
            raise ValueError(f"give [[linear.axis]] once, for every axis, or three times; not {len(self.axis)} times")
        return self


class Mpc(FrozenModel):
    """Prediction with limits; the weights are the regulator's, whose answer also stands in where the solver fails."""

    horizon: Annotated[int, Field(ge=10, le=20)] = 12
    """periods that are planned"""
    iterations_max: Annotated[int, Field(ge=1)] = 100
    """rounds of the solver in one tick; where it needs more the regulator answers, clipped"""
    stroke_min_m: float
    """beyond which no plan goes, unless the reference does"""
    stroke_max_m: float

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.stroke_min_m >= self.stroke_max_m:
            raise ValueError("stroke_min_m must lie below stroke_max_m")
        return self


Taps = Annotated[tuple[float, ...], Field(min_length=1, max_length=40)]


class InnovationFilter(FrozenModel):
    """Taps of the Youla filter for buses of one period and delay, in N/m."""

    period_us: Annotated[int, Field(gt=0)]
    delay_periods: Annotated[int, Field(ge=1, le=2)] = 1
    sense_delay_max_us: Annotated[float, Field(gt=0, le=1000)] = 1000.0
    """for stages whose sense electronics delay by so much at most, and by more than those of other filters"""
    plane: Taps
    """q_0, q_1, ... of x and of y"""
    z: Taps
    quiet_plane: Taps | None = None
    """the same in a quiet hold: less noise, less rejection; left out, a quiet hold is like any other"""
    quiet_z: Taps | None = None

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if (self.quiet_plane is None) != (self.quiet_z is None):
            raise ValueError("give both quiet_plane and quiet_z, or neither")
        counts = {name: len(taps) for name, taps in self if name.endswith(("plane", "z")) and taps is not None}
        if len(set(counts.values())) > 1:
            words = ", ".join(f"{name} has {count}" for name, count in counts.items())
            raise ValueError(f"of the taps, {words}; give all as many, with zeros")
        return self


class Youla(FrozenModel):
    """The state feedback of lqg, and a filter of the innovations beside it: w = -sum_j q_j nu(k - j). ``pkxyz tune``
    finds the taps, which hold for one stage, and for the estimator and the regulator of the same file.
    """

    filter: tuple[InnovationFilter, ...] = ()
    """one for each kind of bus, or several for sense chains that lag more or less; on other buses the state feedback
    stands alone"""
    fade_s: Positive = 0.02
    """how long the filter takes to fade to that of a quiet hold, and to come back"""
    quiet_holds: bool = False
    """every hold is a quiet one, without an operator who asks for it"""

    @model_validator(mode="after")
    def _one_for_each(self) -> Self:
        kinds = [(f.period_us, f.delay_periods, f.sense_delay_max_us) for f in self.filter]
        twice = [kind for kind in kinds if kinds.count(kind) > 1]
        if twice:
            period_us, _, lag_us = twice[0]
            raise ValueError(
                f"there are two filters for a period of {period_us} us and sense delays up to {lag_us:g} us; remove one"
            )
        return self

    def place_of_filter(self, period_us: int, delay_periods: int, sense_delay_us: float) -> int | None:
        """Which of ``filter`` is for a bus and a stage: of those for the bus, the one with the least limit that the
        sense delay keeps, or else the largest. None without any for that bus.
        """
        for_bus = [
            (f.sense_delay_max_us < sense_delay_us, abs(f.sense_delay_max_us - sense_delay_us), place)
            for place, f in enumerate(self.filter)
            if (f.period_us, f.delay_periods) == (period_us, delay_periods)
        ]
        return min(for_bus)[2] if for_bus else None


LAWS = Literal["lqg", "youla", "open_loop", "pi_notch", "irc", "hinf", "linear", "mpc"]
SECTIONS = ("youla", "pi_notch", "irc", "hinf", "linear", "mpc")
"""Laws with a section of their own, which has their name."""
