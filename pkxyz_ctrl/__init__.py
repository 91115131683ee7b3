"""Real-time controller of a parallel-kinematics XYZ MEMS stage.

``Stage`` is the front door: ``Stage.load("reconstructed")``. ``connect`` reaches a stage that ``pkxyz serve`` operates.
"""

from typing import TYPE_CHECKING, Any

from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache

if TYPE_CHECKING:
    from pkxyz_ctrl.client.plain import connect as connect
    from pkxyz_ctrl.client.stage import connect_async as connect_async
    from pkxyz_ctrl.stage import Stage as Stage

choose_kernel_cache()

__all__ = ["Stage", "connect", "connect_async"]


def __getattr__(name: str) -> Any:
    """Each on first use, so that a driver or a gate alone does not wait for compiled kinematics."""
    if name == "Stage":
        from pkxyz_ctrl.stage import Stage

        return Stage
    if name == "connect":
        from pkxyz_ctrl.client.plain import connect

        return connect
    if name == "connect_async":
        from pkxyz_ctrl.client.stage import connect_async

        return connect_async
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
