"""Clocks and ports of this machine; the only room of the controller that knows python-can."""
