"""Sixteen devices in the vectors of one core: kernels that run one, widened.

A kernel is written once, for one record. Its LLVM IR, before any target is chosen, is read here and written again with
a vector with a lane for each device in the place of each number that may differ from one to the next; their records
lie interleaved, so that one load fetches a field of all. Arithmetic is that of the scalar code, operation by
operation, so each lane has its bits.

Where lanes part, the blocks that some of them take run under a mask, one after another; as long as all take the same
way it is a branch as ever.
"""
