"""One file a command of ``pkxyz``."""
