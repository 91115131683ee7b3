"""One run of one scenario: its file, its folder, its figures, and the run played once more."""
