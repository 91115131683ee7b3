"""What a key means is read from behind its field, as pydantic would read it at every start."""

from typing import Annotated

import pytest
from pydantic import BaseModel, ConfigDict, Field

from pkxyz_ctrl.config.described import meaning
from pkxyz_ctrl.trajectory import Sweep


class Above(BaseModel):
    kept: float = 1.0
    """what a class above says"""


class Told(Above):
    """Says this of itself, and that of its fields."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    one: Annotated[float, Field(gt=0)] = 1.0
    """the first line
    and the second"""
    silent: int = 2
    named: int = Field(3, description="in the field")
    """behind it"""
    listed: tuple[int, ...] = ()
    # a comment between does not belong to it
    """of three"""


@pytest.mark.parametrize("key", ["one", "silent", "named", "listed"])
def test_it_is_what_pydantic_reads(key: str) -> None:
    assert meaning(Told, key) == (Told.model_fields[key].description or "")


def test_a_class_above_tells_of_its_own_fields() -> None:
    assert meaning(Told, "kept") == "what a class above says"


def test_of_a_shipped_model_and_of_no_key() -> None:
    assert Sweep.model_fields["duration_s"].description is None, "read at every start"
    assert meaning(Sweep, "duration_s") == "at full amplitude"
    assert meaning(Sweep, "nobody") == ""
