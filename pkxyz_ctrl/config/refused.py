"""What the operating system refuses, in its own words."""


def reason(error: OSError) -> str:
    """Why, for the middle of a line: ``no such file or directory``."""
    return (error.strerror or str(error)).lower()
