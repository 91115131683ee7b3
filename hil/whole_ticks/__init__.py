"""Whole ticks of the lockstep lane, played in one compiled call: controller, wire, node and plant."""

import pkxyz_ctrl  # noqa: F401  chooses the kernel cache before the first kernel is defined
