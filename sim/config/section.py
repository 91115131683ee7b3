"""What the sections of a plant file are made of."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from sim.config.device import Finite

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Relative = Annotated[float, Field(gt=-0.9, lt=9.0)]
PerChain = tuple[Finite, Finite, Finite]
PerAxis = tuple[Finite, Finite, Finite]
RelativePerChain = tuple[Relative, Relative, Relative]


class Model(BaseModel):
    """A section: unknown keys are refused, values stay as they were read."""

    model_config = ConfigDict(frozen=True, extra="forbid")
