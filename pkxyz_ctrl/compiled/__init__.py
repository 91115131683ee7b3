"""Where compiled kernels are kept, how they are called without detours, and what none of them should compute."""
