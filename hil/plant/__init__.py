"""The software plant as the node meets it: volts in, counts out, and what is true beside them."""

import pkxyz_ctrl  # noqa: F401  chooses the kernel cache before the first kernel of sim is defined
