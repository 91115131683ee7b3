"""One period, from frames to frames: where core, safety and CAN meet."""
