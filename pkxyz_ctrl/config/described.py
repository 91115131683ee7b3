"""What the keys of a configuration mean: the string behind each field of its model.

pydantic could put them into the fields, but reads every source file for it whenever a program starts. They are wanted
for the reference pages and for commented files only.
"""

import ast
import inspect
import textwrap
from functools import cache

from pydantic import BaseModel


def meaning(model: type[BaseModel], key: str) -> str:
    """What a key of a model means; empty if it says nothing, or has no such key."""
    field = model.model_fields.get(key)
    if field is not None and field.description:
        return field.description
    return next((told[key] for told in map(_of_class, model.__mro__) if key in told), "")


@cache
def _of_class(kind: type) -> dict[str, str]:
    """The strings behind the fields that a class itself declares."""
    if not issubclass(kind, BaseModel) or kind is BaseModel:
        return {}
    (declared,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(declared, ast.ClassDef)
    told = {}
    for field, behind in zip(declared.body, declared.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(behind, ast.Expr)
            and isinstance(behind.value, ast.Constant)
            and isinstance(behind.value.value, str)
        ):
            told[field.target.id] = inspect.cleandoc(behind.value.value)
    return told
