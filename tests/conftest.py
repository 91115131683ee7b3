"""Shared by all tests: kernels from the cache that is named after their sources, and the same examples in every run."""

from hypothesis import settings

import pkxyz_ctrl  # noqa: F401

settings.register_profile("same every time", derandomize=True)
settings.load_profile("same every time")
