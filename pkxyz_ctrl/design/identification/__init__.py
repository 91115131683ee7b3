"""From measured responses to modes, gains and springs."""
