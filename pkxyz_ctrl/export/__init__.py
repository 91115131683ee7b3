"""The controller as C: kernels as an object for another processor, records as structs and words, a folder that builds.

The kernels are those that run here. What numba makes of them before it optimises is lowered for the target by the same
LLVM; nothing is translated by hand, and nothing of Python is left.
"""
