"""Ways to close the loop: in lockstep over the simulated bus, composed in one kernel, at the wall clock."""
