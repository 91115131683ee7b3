"""Versions of what computes the numbers of a run."""

import importlib.metadata
import platform
import sys


def versions() -> dict[str, str]:
    """By package, and Python's and the platform's."""
    found = {"python": platform.python_version(), "platform": sys.platform}
    for package in ("pkxyz-ctrl", "numpy", "numba", "scipy"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found
