"""Faults as data: what may go wrong, where, when and how badly, and what then has to happen."""

import pkxyz_ctrl  # noqa: F401  chooses the kernel cache before the first kernel is defined
