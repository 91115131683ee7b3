"""Many devices side by side: the parts of a tick, each kernel widened to a lane of vectors for each of sixteen devices.

What comes out has the bits of ``hil.lanes.many``, which runs one after another and is what other machines have.
"""

import pkxyz_ctrl  # noqa: F401  chooses the kernel cache before the first kernel of sim is defined
