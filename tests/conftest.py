"""Shared by all tests: kernels come from the cache that is named after their sources."""

import pkxyz_ctrl  # noqa: F401
