"""Numbers formatted for people: one that rounds to zero has no sign, on whichever side of zero a processor has it."""

from collections.abc import Iterable


def shown(value: float, spec: str) -> str:
    """Format a number by a format specification of Python, as ".2f" or "+.1%", without fill and alignment."""
    sign, rest = (spec[0], spec[1:]) if spec.startswith(("+", "-", " ")) else ("", spec)
    return f"{float(value):{sign}z{rest}}"


def coordinates(position: Iterable[float], spec: str) -> str:
    """Format the coordinates of a position, each by a format specification: (0.00, -1.25, 1.00)."""
    return f"({', '.join(shown(each, spec) for each in position)})"
