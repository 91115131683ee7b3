"""The CAN bus that is simulated: time, wire, controllers on it, and the same wire as a python-can interface."""

import pkxyz_ctrl  # noqa: F401  chooses the kernel cache before the first kernel is defined
