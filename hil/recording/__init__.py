"""What a run leaves of each tick, written while it runs and read afterwards."""
