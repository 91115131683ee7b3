"""Where a division of 64 bits would cost a board more than all the rest: it has no instruction for one."""

from typing import Final

from pkxyz_ctrl.compiled.kernel import kernel

_FEW_PERIODS: Final = 2


@kernel
def into_period(time_us: int, period_us: int) -> int:
    """``time_us % period_us``, 0 where the period, never negative, is 0. Divides only what is more than a few periods
    long: a time that is ``NEVER_US`` must not be counted down.
    """
    for _ in range(_FEW_PERIODS):
        if time_us >= period_us:
            time_us -= period_us
        elif time_us < 0:
            time_us += period_us
    return time_us if 0 <= time_us < period_us else time_us % period_us
