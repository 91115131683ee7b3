"""One fault: target, kind, time, parameters. In a scenario file an entry of ``[[faults]]``, on the command line a text.

>>> parse("sense.2:wrong_gain@0.3+0.05,gain=1.1")
Fault(target='sense.2', kind='wrong_gain', at_s=0.3, duration_s=0.05, parameters={'gain': 1.1})
"""

import re
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator

from hil.faults.catalogue import KINDS, refusal
from pkxyz_ctrl.config.files import ConfigError, FrozenModel

SYNTAX = "TARGET:KIND@SECONDS[+DURATION][,NAME=VALUE...], such as sense.2:stuck@0.3+0.05"
_TEXT = re.compile(
    r"(?P<target>[^:@]+):(?P<kind>[^:@]+)@(?P<at>[^@+,]+)(\+(?P<duration>[^,]+))?(?P<rest>(,[^,=]+=[^,=]+)*)"
)


class Fault(FrozenModel):
    """Something that goes wrong at a time. Raises a validation error for what ``catalogue`` does not have."""

    target: str
    kind: str
    at_s: Annotated[float, Field(ge=0, le=36_000)]
    """after the first tick; a node's wrong identity at 0 is there from power-on"""
    duration_s: Annotated[float, Field(gt=0, le=36_000)] | None = None
    """absent: for good"""
    parameters: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _exists(self) -> Self:
        reason = refusal(self.target, self.kind, self.parameters)
        if reason is not None:
            raise ValueError(reason)
        return self

    @property
    def family(self) -> str:
        """The target without its part: sense, amplifier, node, bus, controller or plant."""
        return self.target.partition(".")[0]

    @property
    def part(self) -> str:
        """What is behind the target's dot, empty if there is none."""
        return self.target.partition(".")[2]

    @property
    def channel(self) -> int:
        """0, 1 or 2 of a sense or amplifier channel."""
        return int(self.part) - 1

    @property
    def at_us(self) -> int:
        """When it begins, after the first tick."""
        return round(self.at_s * 1e6)

    @property
    def end_us(self) -> int | None:
        """When it ends; None: never."""
        return None if self.duration_s is None else self.at_us + round(self.duration_s * 1e6)

    def is_on(self, t_us: int) -> bool:
        """Whether it acts at a time after the first tick."""
        end_us = self.end_us
        return self.at_us <= t_us and (end_us is None or t_us < end_us)

    def __getitem__(self, parameter: str) -> float:
        """A parameter's value, given or default."""
        return self.parameters.get(parameter, KINDS[self.family][self.kind].parameters[parameter].default)

    def __str__(self) -> str:
        """The text that ``parse`` reads."""
        duration = "" if self.duration_s is None else f"+{self.duration_s:g}"
        rest = "".join(f",{name}={value:g}" for name, value in self.parameters.items())
        return f"{self.target}:{self.kind}@{self.at_s:g}{duration}{rest}"


def parse(text: str) -> Fault:
    """The fault that a text of the command line means. Raises ``ConfigError``."""
    match = _TEXT.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"--fault {text}: is not {SYNTAX}")
    try:
        pairs = [pair.split("=") for pair in match["rest"].split(",")[1:]]
        return Fault(
            target=match["target"],
            kind=match["kind"],
            at_s=float(match["at"]),
            duration_s=None if match["duration"] is None else float(match["duration"]),
            parameters={name: float(value) for name, value in pairs},
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = str(first["msg"]).removeprefix("Value error, ")
        raise ConfigError(f"--fault {text}: {where + ': ' if where else ''}{message}") from None
    except ValueError:
        raise ConfigError(f"--fault {text}: a number is expected in each place of {SYNTAX}") from None
