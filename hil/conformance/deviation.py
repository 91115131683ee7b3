"""How a check ends that does not pass: with what came instead, or with why it could not be made."""


class DeviationError(Exception):
    """The node did something else than expected; the text says what came."""


class NotTestedError(Exception):
    """The check could not be made; the text says why. Not a verdict on the node."""


def first_few(deviations: list[str], limit: int = 6) -> str:
    """A list for one line of a report."""
    more = len(deviations) - limit
    return "; ".join(deviations[:limit]) + (f"; and {more} more" if more > 0 else "")


def deviate_if(deviations: list[str]) -> None:
    """Raise ``DeviationError`` if there is anything in the list."""
    if deviations:
        raise DeviationError(first_few(deviations))
