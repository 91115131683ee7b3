"""Commands that run a loop many times, for one question."""
