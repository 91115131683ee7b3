"""One axis of the stage as an EPICS motor record, in um: the fields that ophyd and ophyd-async connect to.

User coordinates are dial coordinates plus OFF; dial coordinates are those of the stage. LLM and HLM follow what the
combs can hold while the other axes are at their targets, unless somebody has narrowed them.
"""

import math
from collections.abc import Callable
from typing import Any, Final

from caproto import ChannelData

from pkxyz_ctrl.client.reply import StageError, Status
from pkxyz_ctrl.client.stage import Axis
from pkxyz_ctrl.instrument.axis_moves import AXES, AxisMoves, MotionLimits
from pkxyz_ctrl.instrument.records import Choice, Number, Whole, Words, raise_alarm

UM: Final = 1e-6
PRECISION: Final = 4
"""Digits behind the point: 0.1 nm."""

FIELDS: Final[dict[str, str]] = {
    "VAL": "target; done when the stage is in position there",
    "RBV": "position, as estimated",
    "DVAL": "target without OFF",
    "DRBV": "position without OFF",
    "OFF": "what is added to dial coordinates",
    "SET": "Set: VAL says where the axis is, and nothing moves",
    "FOFF": "always Variable: SET changes OFF",
    "DIR": "always Pos",
    "VELO": "velocity of moves, at most VMAX",
    "VMAX": "most velocity: that of moves which name none",
    "ACCL": "time to VELO, in s",
    "EGU": "um",
    "PREC": "digits behind the point",
    "RDBD": "in position: so near to the target",
    "MRES": "resolution that is said: 0.1 nm",
    "ERES": "the same",
    "SREV": "1",
    "UREV": "MRES",
    "DMOV": "1 when all that was asked is done",
    "MOVN": "1 while the set-point moves",
    "TDIR": "1 towards larger values",
    "LLM": "least target",
    "HLM": "largest target",
    "DLLM": "LLM without OFF",
    "DHLM": "HLM without OFF",
    "LLS": "1 where the position is below LLM",
    "HLS": "1 where it is above HLM",
    "LVIO": "1 after a move that was refused or failed",
    "STOP": "1 stops all axes, and needs no control",
    "HOMF": "1: park, measure the sense offsets, go back",
    "HOMR": "the same",
    "OUT": "what it controls",
    "DESC": "the same in words",
    "RTYP": "motor",
}
"""Each field of the record in a few words."""


class MotorRecord:
    """``channels``: by name, as caproto's server wants them."""

    def __init__(self, name: str, axis: Axis, moves: AxisMoves, say: Callable[[str], Any]) -> None:
        """``say`` takes what went wrong, in words."""
        self._axis, self._moves, self._say = axis, moves, say
        self._n = AXES.index(axis)
        self._asked = 0  # moves of this axis under way
        self._soft = [-math.inf, math.inf]  # dial limits that somebody has set, in um
        described = moves.stage.description
        velocity, acceleration, jerk = described["limits"]
        self._limits = MotionLimits(velocity, acceleration, jerk)
        self._dial_target = 0.0

        def number(value: float = 0.0, **metadata: Any) -> Number:
            return Number(value=value, precision=PRECISION, units="um", **metadata)

        def words(value: str) -> Words:
            return Words(value=value)

        speed = velocity / UM
        resolution = 10.0**-PRECISION
        fields: dict[str, Any] = {name: number() for name in ("VAL", "RBV", "DVAL", "DRBV", "OFF")}
        fields |= {name: number() for name in ("LLM", "HLM", "DLLM", "DHLM")}
        fields |= {name: Number(value=speed, precision=PRECISION, units="um/s") for name in ("VELO", "VMAX")}
        fields |= {"RDBD": number(described["window_m"] / UM)}
        fields |= {name: number(resolution) for name in ("MRES", "ERES", "UREV")}
        fields["ACCL"] = Number(value=velocity / acceleration, precision=6, units="s")
        fields |= {name: Whole(value=0) for name in ("MOVN", "TDIR", "LLS", "HLS", "LVIO", "STOP", "HOMF", "HOMR")}
        fields |= {"DMOV": Whole(value=1), "SREV": Whole(value=1), "PREC": Whole(value=PRECISION)}
        fields["SET"] = Choice(value="Use", enum_strings=("Use", "Set"))
        fields["FOFF"] = Choice(value="Variable", enum_strings=("Variable", "Frozen"))
        fields["DIR"] = Choice(value="Pos", enum_strings=("Pos", "Neg"))
        fields |= {"EGU": words("um"), "RTYP": words("motor"), "OUT": words(f"@pkxyz({described['stage']},{axis})")}
        fields["DESC"] = words(f"{axis} of {described['stage']}")
        assert fields.keys() == FIELDS.keys()
        self._field = fields
        for field, put in self._puts().items():
            fields[field].put = put
        self.channels: dict[str, ChannelData] = {f"{name}.{field}": channel for field, channel in fields.items()}
        self.channels[name] = fields["VAL"]

    def _puts(self) -> dict[str, Any]:
        return {
            "VAL": self._put_target, "DVAL": self._put_dial, "STOP": self._put_stop, "HOMF": self._put_home,
            "HOMR": self._put_home, "OFF": self._put_offset, "SET": self._put_set, "VELO": self._put_velocity,
            "ACCL": self._put_acceleration, "LLM": self._put_low, "HLM": self._put_high,
            "DLLM": lambda v: self._put_low(v + self._offset), "DHLM": lambda v: self._put_high(v + self._offset),
        }  # fmt: skip

    @property
    def _offset(self) -> float:
        return float(self._field["OFF"].value)

    # -- what is written -----------------------------------------------------------------------------------------------

    async def _put_target(self, value: float) -> None:
        """To a target in user coordinates; returns once the stage is in position. Raises ``StageError``."""
        if self._field["SET"].value == "Set":
            await self._put_offset(float(value) - self._dial_target)
            return
        await self._put_dial(float(value) - self._offset)

    @property
    def _dial_readback(self) -> float:
        return float(self._field["DRBV"].value)

    async def _put_dial(self, value: float) -> None:
        field, stops = self._field, self._moves.stops
        self._asked += 1
        self._dial_target = float(value)
        await self._tell_target()
        await field["TDIR"].tell_change(int(value > self._dial_readback))
        await field["DMOV"].tell_change(0)
        wrong: StageError | None = None
        low, high = self._soft
        try:
            if not low <= value <= high:
                raise StageError(f"{self._axis} = {value:g} um, limits {low:g} to {high:g} um were set")
            await self._moves.move(self._axis, value * UM, self._limits_of_a_move())
        except StageError as error:
            if self._moves.stops == stops:  # one that STOP ended has ended as it should
                wrong = error
                self._say(str(error))
        finally:
            self._asked -= 1
        await self.look(await self._moves.stage.next_status(), is_wrong=wrong is not None)
        if wrong is not None:
            raise wrong

    async def _put_stop(self, value: int) -> None:
        if value:
            await self._moves.stand_still()

    async def _put_home(self, value: int) -> None:
        if value:
            await self._moves.take_control()
            await self._moves.stage.auto_zero()

    async def _put_offset(self, value: float) -> None:
        await self._field["OFF"].tell(float(value))
        await self._tell_target()
        await self.look(await self._moves.stage.next_status())

    async def _put_set(self, value: str | int) -> None:
        await self._field["SET"].tell("Set" if value in ("Set", 1) else "Use")

    async def _put_velocity(self, value: float) -> None:
        most = self._field["VMAX"].value
        if not 0.0 < value <= most:
            raise StageError(f"VELO = {value:g} um/s, limits 0 to {most:g} um/s")
        await self._field["VELO"].tell(float(value))

    async def _put_acceleration(self, value: float) -> None:
        if not 1e-6 <= value <= 1e3:
            raise StageError(f"ACCL = {value:g} s, limits 1e-06 to 1000 s")
        await self._field["ACCL"].tell(float(value))

    async def _put_low(self, value: float) -> None:
        self._soft[0] = float(value) - self._offset
        await self.look(await self._moves.stage.next_status())

    async def _put_high(self, value: float) -> None:
        self._soft[1] = float(value) - self._offset
        await self.look(await self._moves.stage.next_status())

    def _limits_of_a_move(self) -> MotionLimits:
        velocity = self._field["VELO"].value * UM
        most = self._limits
        return MotionLimits(
            velocity, min(most.acceleration_m_per_s2, velocity / self._field["ACCL"].value), most.jerk_m_per_s3
        )

    # -- what is told --------------------------------------------------------------------------------------------------

    async def look(self, status: Status, *, is_wrong: bool | None = None) -> None:
        """Tell what is so; ``is_wrong``: what was asked has ended, and whether badly."""
        field, position = self._field, float(status.position_m[self._n]) / UM
        if is_wrong is not None and not self._asked:
            await field["LVIO"].tell_change(int(is_wrong))
            for name in ("RBV", "VAL"):
                await raise_alarm(field[name], is_wrong)
        if math.isfinite(position):
            await field["DRBV"].tell(position)
            await field["RBV"].tell(position + self._offset)
        if not self._asked:
            self._dial_target = round(float(status.target_m[self._n]) / UM, 9)
            await self._tell_target()
        low, high = await self._tell_limits(status)
        await field["LLS"].tell_change(int(position < low - field["RDBD"].value))
        await field["HLS"].tell_change(int(position > high + field["RDBD"].value))
        moves = status.activity in ("moving", "jogging", "scanning", "stopping", "homing")
        await field["MOVN"].tell_change(int(moves))
        if not self._asked:
            await field["DMOV"].tell_change(int(not moves))

    async def _tell_target(self) -> None:
        for name, offset in (("VAL", self._offset), ("DVAL", 0.0)):
            await self._field[name].tell_change(self._dial_target + offset)

    async def _tell_limits(self, status: Status) -> tuple[float, float]:
        """Least and largest dial coordinate, in um: of the combs and of whoever has narrowed them."""
        low, high = (float(v) / UM for v in status.range_m[self._n])
        low, high = max(low, self._soft[0]), min(high, self._soft[1])
        if math.isnan(low) or math.isnan(high):
            return -math.inf, math.inf
        for name in ("VAL", "RBV"):  # before LLM and HLM, at whose change clients look at these
            await self._field[name].tell_limits(*(round(v + self._offset, PRECISION) for v in (low, high)))
        for name, value in (("LLM", low + self._offset), ("HLM", high + self._offset), ("DLLM", low), ("DHLM", high)):
            await self._field[name].tell_change(round(value, PRECISION))
        return low, high
