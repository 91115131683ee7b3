"""A bound of a figure, in scenario and process files."""

from typing import Self

from pydantic import model_validator

from pkxyz_ctrl.config.files import FrozenModel


class Bound(FrozenModel):
    """Where a figure has to lie, ends included. Two-sided bounds also catch an improvement that nobody can explain."""

    min: float | None = None
    max: float | None = None

    @model_validator(mode="after")
    def _bounds_something(self) -> Self:
        if self.min is None and self.max is None:
            raise ValueError("give max, min or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g}, so no value could pass")
        return self
