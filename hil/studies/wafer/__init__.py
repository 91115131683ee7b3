"""Which share of a wafer works: devices sampled from a process, their figures, what reduces the share."""
