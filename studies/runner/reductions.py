"""Reductions: what a column of a table says of the rows of a group. Each returns a function from rows to a value.

A value is the name of a row's field, or a function of the row; where it is not finite there was nothing to measure,
and the row does not count. Of no rows there is no mean: NaN.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any

import numpy as np

Value = str | Callable[[Any], Any]
Reduction = Callable[[Sequence[Any]], Any]


def count(where: Value | None = None) -> Reduction:
    """Count the rows, or those of which the value holds."""
    holds = (lambda row: True) if where is None else _getter(where)
    return lambda rows: sum(bool(holds(row)) for row in rows)


def mean(value: Value) -> Reduction:
    """Return the mean."""
    return lambda rows: float(np.mean(finite(rows, value)))


def rms(value: Value) -> Reduction:
    """Return the root of the mean square."""
    return lambda rows: float(np.sqrt(np.mean(finite(rows, value) ** 2)))


def quantile(value: Value, level: float) -> Reduction:
    """Return a quantile."""
    return lambda rows: float(np.quantile(finite(rows, value), level))


def median(value: Value) -> Reduction:
    """Return the median."""
    return quantile(value, 0.5)


def largest(value: Value) -> Reduction:
    """Return the largest."""
    return lambda rows: float(np.max(finite(rows, value)))


def smallest(value: Value) -> Reduction:
    """Return the smallest."""
    return lambda rows: float(np.min(finite(rows, value)))


def farthest(value: Value) -> Reduction:
    """Return the value that is farthest from zero, with its sign."""
    return lambda rows: float(max(finite(rows, value), key=abs))


def total(value: Value) -> Reduction:
    """Return the sum; 0 of nothing."""
    return lambda rows: float(np.nansum(finite(rows, value)))


def among(where: Value, reduction: Reduction) -> Reduction:
    """Return the reduction of those rows of which `where` holds."""
    holds = _getter(where)
    return lambda rows: reduction([row for row in rows if holds(row)])


def finite(rows: Iterable[Any], value: Value) -> np.ndarray:
    """Return the values that are finite as an array that is never empty: of none it holds NaN."""
    get = _getter(value)
    found = [number for row in rows if (number := get(row)) is not None and math.isfinite(number)]
    return np.array(found or [np.nan], dtype=float)


def _getter(value: Value) -> Callable[[Any], Any]:
    return attrgetter(value) if isinstance(value, str) else value
