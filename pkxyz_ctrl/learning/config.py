"""What a scenario says about learning."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pkxyz_ctrl.config.files import ConfigError, FrozenModel


class LearningError(ConfigError):
    """A correction that can't be learnt or used. The message says what doesn't fit and what to do."""


class LearningConfig(FrozenModel):
    """The section [learning] of a scenario."""

    mode: Literal["learn", "apply", "refresh"] = "learn"
    """learn: from nothing; apply: a stored correction as it is; refresh: a stored one, and go on learning"""
    file: Annotated[str, Field(min_length=1)] | None = None
    """the stored correction of apply and refresh; a path, in a scenario from the scenario's folder"""
    cutoff_hz: Annotated[float, Field(gt=0)] = 450.0
    """harmonics up to here are learnt: below the resonance, where a device answers as its model does"""
    gain: Annotated[float, Field(gt=0, le=1)] = 1.0
    """share of the error, as far as it is known, that one update takes back"""
    updates: Annotated[int, Field(ge=1)] | None = None
    """most updates; unset: until the scan ends"""

    @model_validator(mode="after")
    def _file_where_needed(self) -> Self:
        if self.mode == "learn" and self.file is not None:
            raise ValueError("learn begins with nothing; with a file, mode is 'apply' or 'refresh'")
        if self.mode != "learn" and self.file is None:
            raise ValueError(f"mode {self.mode!r} needs the file of a stored correction")
        return self
