"""Numbers as people read them: one that rounds to zero has no sign, whichever side of zero a processor rounds it to."""

from collections.abc import Iterable


def shown(value: float, spec: str) -> str:
    """Return a number by one of Python's format specifications, as ".2f" or "+.1%", without fill and alignment."""
    sign, rest = (spec[0], spec[1:]) if spec.startswith(("+", "-", " ")) else ("", spec)
    return f"{float(value):{sign}z{rest}}"


def coordinates(position: Iterable[float], spec: str) -> str:
    """Return the coordinates of a place, each by a format specification: (0.00, -1.25, 1.00)."""
    return f"({', '.join(shown(each, spec) for each in position)})"
