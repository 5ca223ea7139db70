"""Texts with computed numbers, compared by their parts: words to the letter, numbers as numbers.

Processors round differently, so a number may differ by one in the last digit that is printed. Whole numbers count
something, and must be equal.
"""

import re
from decimal import Decimal

_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def same_text(said: str, expected: str) -> bool:
    """Return whether two texts have the same words, and the same numbers but for one in the last digit."""
    return _NUMBER.split(said) == _NUMBER.split(expected) and all(
        abs(number - wanted) <= _tolerance(wanted)
        for number, wanted in zip(_numbers(said), _numbers(expected), strict=True)
    )


def _numbers(text: str) -> list[Decimal]:
    return [Decimal(number) for number in _NUMBER.findall(text)]


def _tolerance(number: Decimal) -> Decimal:
    """Return one unit of the last digit; 0 if there is no digit after the point."""
    return Decimal(1).scaleb(int(number.as_tuple().exponent)) if number.as_tuple().exponent < 0 else Decimal(0)
