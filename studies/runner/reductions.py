"""Reductions of a group of rows to one value of a table. Each function here returns a function of the rows.

A value is the name of a row's field, or a function of the row. Rows whose value is not finite are ignored; means
and extremes of no rows are NaN.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any

import numpy as np

Value = str | Callable[[Any], Any]
Reduction = Callable[[Sequence[Any]], Any]


def count(where: Value | None = None) -> Reduction:
    """Return the number of rows, or of those whose value is true."""
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
    """Return the sum; 0 without rows."""
    return lambda rows: float(np.nansum(finite(rows, value)))


def among(where: Value, reduction: Reduction) -> Reduction:
    """Return the reduction of the rows for which `where` is true."""
    holds = _getter(where)
    return lambda rows: reduction([row for row in rows if holds(row)])


def finite(rows: Iterable[Any], value: Value) -> np.ndarray:
    """Return the finite values as an array, or [NaN] if there are none."""
    get = _getter(value)
    found = [number for row in rows if (number := get(row)) is not None and math.isfinite(number)]
    return np.array(found or [np.nan], dtype=float)


def _getter(value: Value) -> Callable[[Any], Any]:
    return attrgetter(value) if isinstance(value, str) else value
