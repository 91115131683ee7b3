"""The amplifier as the controller meets it: a CiA 301 device with the analogue part of CiA 401."""

import pkxyz_ctrl  # noqa: F401  chooses the kernel cache before the first kernel is defined
