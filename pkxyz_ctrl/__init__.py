"""Real-time controller of a parallel-kinematics XYZ MEMS stage.

``Stage`` is the front door: ``Stage.load("reconstructed")``.
"""

from typing import TYPE_CHECKING, Any

from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache

if TYPE_CHECKING:
    from pkxyz_ctrl.stage import Stage as Stage

choose_kernel_cache()

__all__ = ["Stage"]


def __getattr__(name: str) -> Any:
    """``Stage`` on first use, so that a driver or a gate alone does not wait for compiled kinematics."""
    if name == "Stage":
        from pkxyz_ctrl.stage import Stage

        return Stage
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
