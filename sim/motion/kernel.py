"""How what runs in a tick is compiled: kept between runs, IEEE 754 as it stands, and with no heap.

Without numba's runtime nothing counts references to arrays; and a kernel that takes memory does not compile.
"""

from numba import njit

kernel = njit(cache=True, error_model="numpy", _nrt=False)

inlined = njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)
"""Of what is called in a loop over instants: LLVM makes vectors of one only if no call is in it."""
