"""Compiled kernels called directly, for arguments whose types never change."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import typeof


def direct(kernel: Any, *examples: object) -> Callable[..., Any]:
    """``kernel``, compiled for arguments of the types of ``examples``, and to be called with no others.

    At each call numba looks up the types of all arguments, 0.25 us for each structured array; this leaves that out.
    Lengths may differ, but dtype, number of dimensions and contiguity must not, and nobody checks them. With the
    compiler off it is ``kernel`` itself.
    """
    if not hasattr(kernel, "get_overload"):
        plain: Callable[..., Any] = kernel
        return plain
    key = kernel, *map(_kind, examples)
    compiled = _compiled.get(key)
    if compiled is None:
        types = tuple(typeof(example) for example in examples)
        kernel.compile(types)
        compiled = _compiled[key] = kernel.get_overload(types)
    return compiled


_compiled: dict[tuple[Any, ...], Callable[..., Any]] = {}  # numba takes some ms to say a large record's type


def _kind(example: object) -> object:
    """What decides the type of ``example`` for numba."""
    if isinstance(example, tuple):
        return tuple(map(_kind, example))
    if not isinstance(example, np.ndarray):
        return type(example)
    flags = example.flags
    return example.dtype, example.ndim, flags.c_contiguous, flags.f_contiguous, flags.writeable, flags.aligned
