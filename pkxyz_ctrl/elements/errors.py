"""Errors of the design theory. Both are ``ValueError``: the command line turns them into one line and exit code 2."""

import math


class GeometryError(ValueError):
    """Dimensions or strokes with which the mechanism does not exist. The message holds the violated inequality."""


class InfeasibleDesignError(ValueError):
    """Requirements that no dimensions fulfil. The message names the binding constraint and by how much it is missed."""


def require_positive(**quantities: float) -> None:
    """Raise ``GeometryError`` for the first of the named quantities that is not a finite number above 0."""
    for name, value in quantities.items():
        if not (math.isfinite(value) and value > 0):
            raise GeometryError(f"{name} > 0 is violated: {name} = {value:g}")
