"""Everything broken once, under every law, and what has to hold then."""
