"""The CAN bus that is simulated: time, wire, controllers on it, and the same wire as a python-can interface."""
