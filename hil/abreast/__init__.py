"""Eight devices in the vectors of one core: the kernels that run one, widened.

A kernel is written once, for one record. Its LLVM IR, before any target is chosen, is read here and written again with
a vector of eight lanes in the place of each number that may differ from device to device; records of eight devices
lie interleaved, so that one load fetches a field of all. Arithmetic is that of the scalar code, operation by
operation, so each lane has its bits.

Where lanes part, the blocks that some of them take run under a mask, one after another; as long as all take the same
way it is a branch as ever. Frames, gates and drivers are not in it: ``hil.lanes.many`` runs what has none.
"""
