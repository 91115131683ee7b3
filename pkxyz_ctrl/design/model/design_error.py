"""What a design raises that does not come out; apart, so that who catches it need not import how one designs."""


class DesignError(RuntimeError):
    """A design that does not hold what it promised; the message says which check failed and by how much."""
