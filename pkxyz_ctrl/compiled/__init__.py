"""Where compiled kernels are kept, and how they are called without detours."""
