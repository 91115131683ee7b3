"""The stage as it moves: its mechanism, its drive, one step of time, and the records that kernels share."""
