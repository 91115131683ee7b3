"""What a warning in a row says, in words: what of the device has changed, and by how much."""

import numpy as np
from numpy.typing import NDArray

_COMBS, _CHAINS = (1, 2, 3), (4, 5, 6)


def in_words(warning: int, share: float) -> str:
    """``warning`` and ``warning_share`` of a row; empty without a warning."""
    size = f"{abs(share) * 100:.1f} %"
    if warning in _COMBS:
        return f"comb {warning} pulls {size} {'more' if share > 0 else 'less'} than it did"
    if warning in _CHAINS:
        return f"the springs of chain {warning - 3} are {size} {'stiffer' if share > 0 else 'softer'} than they were"
    if warning:
        return f"the out-of-plane hinges are {size} {'stiffer' if share > 0 else 'softer'} than they were"
    return ""


class Warnings:
    """Collects those of a run: when each cause was first named, and the number that it had in the end."""

    def __init__(self) -> None:
        self._found: dict[int, tuple[int, float]] = {}

    def update(self, rows: NDArray[np.void]) -> None:
        """Take in rows (n,) of ``ROW``, in order."""
        for cause in np.unique(rows["warning"][rows["warning"] != 0]).tolist():
            named = rows[rows["warning"] == cause]
            first_us, _ = self._found.get(cause, (int(named["t_us"][0]), 0.0))
            self._found[cause] = first_us, float(named["warning_share"][-1])

    @property
    def sentences(self) -> tuple[str, ...]:
        """In the order in which they came."""
        ordered = sorted((first_us, cause, share) for cause, (first_us, share) in self._found.items())
        return tuple(f"at {t_us * 1e-6:.2f} s: {in_words(cause, share)}" for t_us, cause, share in ordered)
