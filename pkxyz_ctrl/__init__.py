"""Real-time controller of a parallel-kinematics XYZ MEMS stage. ``from pkxyz_ctrl.stage import Stage`` is the front door."""

from pkxyz_ctrl.kernel_cache import choose_kernel_cache

choose_kernel_cache()
