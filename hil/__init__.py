"""The harness: simulated bus, amplifier node, lanes, scenarios, recordings, reports and the command line."""

import pkxyz_ctrl  # noqa: F401  chooses the kernel cache before the first kernel of sim is defined
