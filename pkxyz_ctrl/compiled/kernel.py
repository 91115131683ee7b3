"""How what runs in a tick is compiled: kept between runs, IEEE 754 as it stands, and with no heap.

Without numba's runtime nothing counts references to arrays, which takes a tenth of a tick and a quarter of lockstep;
and a kernel that takes memory does not compile.
"""

from numba import njit

from pkxyz_ctrl.compiled.whole_program import optimise_whole_programs, rare

__all__ = ["kernel", "rare"]

optimise_whole_programs()

kernel = njit(cache=True, error_model="numpy", _nrt=False)
