"""Configuration files: strict, frozen, with units in the names and an error that names the remedy."""
