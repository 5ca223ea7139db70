"""Slacks of constraints between bounds, the multipliers of those bounds, and the barrier that keeps slacks inside.

Arrays of (m,) lie together as rows: BOUNDS of what is given, STATE of what a search changes, and a step of it. A bound
that is not there lies far away and has no barrier, so that all constraints go through the same arithmetic, several at
a time.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FAR = 1e20
COMPLEMENTARY = 1e10
# how far a multiplier may be from what the barrier makes of its slack, as a factor

_SUMS = {"contract", "reassoc", "nsz", "arcp"}  # freedom that what is not a number survives
_LARGEST = _SUMS | {"nnan"}


@njit(cache=True)
def bounds_of(lower: NDArray, upper: NDArray) -> NDArray:
    """(5, m) lower and upper bound, whether each is there, and whether either is."""
    bounds = np.empty((5, len(lower)))
    for j in range(len(lower)):
        has_low, has_high = lower[j] > -np.inf, upper[j] < np.inf
        bounds[0, j], bounds[1, j] = lower[j] if has_low else -FAR, upper[j] if has_high else FAR
        bounds[2, j], bounds[3, j], bounds[4, j] = has_low, has_high, has_low or has_high
    return bounds


@njit(cache=True, error_model="numpy")
def first(g, bounds, barrier, push, state):
    """Slacks where the constraints are, but inside by `push` of the span between bounds at least; multipliers that the
    barrier makes of them.

    Slacks that start next to a bound would hold back every step: better to start a little off the constraints.
    """
    for j in range(len(g)):
        lower, upper = bounds[0, j], bounds[1, j]
        room = push * min(upper - lower, 2.0)
        s = min(max(g[j], lower + room), upper - room)
        state[0, j] = s
        state[1, j] = bounds[2, j] * barrier / (s - lower)
        state[2, j] = bounds[3, j] * barrier / (upper - s)


@njit(cache=True, error_model="numpy", fastmath=_SUMS)
def pulls(bounds, state, multipliers, stiffness):
    """Fill in the multipliers of the constraints and the stiffness of their slacks."""
    lower, upper = bounds[0], bounds[1]
    s, low, high = state[0], state[1], state[2]
    for j in range(len(s)):
        multipliers[j] = high[j] - low[j]
        stiffness[j] = low[j] / (s[j] - lower[j]) + high[j] / (upper[j] - s[j])


@njit(cache=True, error_model="numpy", fastmath=_LARGEST)
def errors(g, bounds, state, barrier):
    """The largest |g - s|, and the largest difference of a slack's product from the barrier. For finite numbers."""
    lower, upper, has_low, has_high, active = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, low, high = state[0], state[1], state[2]
    infeasible, off = 0.0, 0.0
    for j in range(len(s)):
        infeasible = max(infeasible, active[j] * abs(g[j] - s[j]))
        off = max(off, abs(low[j] * (s[j] - lower[j]) - has_low[j] * barrier))
        off = max(off, abs(high[j] * (upper[j] - s[j]) - has_high[j] * barrier))
    return infeasible, off


@njit(cache=True, error_model="numpy", fastmath=_SUMS)
def forces(g, bounds, state, stiffness, barrier, force, pull):
    """The barrier's gradient by slack; and what constraints add to the right side of the Newton step, by constraint."""
    lower, upper, has_low, has_high, active = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s = state[0]
    for j in range(len(s)):
        force[j] = barrier * (has_high[j] / (upper[j] - s[j]) - has_low[j] / (s[j] - lower[j]))
        pull[j] = force[j] + active[j] * stiffness[j] * (g[j] - s[j])


@njit(cache=True, error_model="numpy", fastmath=_LARGEST)
def steps(g, along, bounds, state, force, barrier, most, step):
    """Fill in the step, where g changes by `along`.

    Gives (slope of the barrier along it, longest share of it that leaves (1 - most) of the room, the same for
    multipliers). For finite numbers.
    """
    lower, upper, has_low, has_high, active = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, low, high = state[0], state[1], state[2]
    ds, dlow, dhigh = step[0], step[1], step[2]
    slope, fastest, fastest_dual = 0.0, 0.0, 0.0
    for j in range(len(s)):
        below, above = s[j] - lower[j], upper[j] - s[j]
        d = active[j] * (g[j] - s[j] + along[j])
        ds[j] = d
        slope += force[j] * d
        fastest = max(fastest, max(-d / below, d / above))
        dl = (has_low[j] * barrier - low[j] * d) / below - low[j]
        dh = (has_high[j] * barrier + high[j] * d) / above - high[j]
        dlow[j], dhigh[j] = dl, dh
        fastest_dual = max(fastest_dual, -dl / (low[j] + 1e-300))
        fastest_dual = max(fastest_dual, -dh / (high[j] + 1e-300))
    return slope, min(1.0, most / max(fastest, 1e-30)), min(1.0, most / max(fastest_dual, 1e-30))


@njit(cache=True, error_model="numpy", fastmath=_SUMS)
def standing(g, bounds, state, step, share, barrier, rows):
    """How infeasible the slacks are after a share of the step, as a sum, and what the barrier adds to the cost.

    g is taken as `rows` rows of as many constraints each, and a rest: a logarithm of a column takes less time than one
    of each of its entries.
    """
    lower, upper, has_low, has_high, active = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, ds = state[0], step[0]
    columns = len(g) // rows
    products = np.ones(columns)
    infeasible, total = 0.0, 0.0
    for r in range(rows):
        for c in range(columns):
            j = r * columns + c
            slack = s[j] + share * ds[j]
            infeasible += active[j] * abs(g[j] - slack)
            products[c] *= has_low[j] * (slack - lower[j]) + (1.0 - has_low[j])
            products[c] *= has_high[j] * (upper[j] - slack) + (1.0 - has_high[j])
    for c in range(columns):
        total += math.log(products[c])
    for j in range(rows * columns, len(g)):
        slack = s[j] + share * ds[j]
        infeasible += active[j] * abs(g[j] - slack)
        total += math.log(has_low[j] * (slack - lower[j]) + (1.0 - has_low[j]))
        total += math.log(has_high[j] * (upper[j] - slack) + (1.0 - has_high[j]))
    return infeasible, -barrier * total


@njit(cache=True, error_model="numpy", fastmath=_SUMS)
def advance(bounds, state, step, share, share_dual, barrier):
    """Take the step, in place; multipliers stay within a factor of what the barrier makes of their slacks."""
    lower, upper, has_low, has_high = bounds[0], bounds[1], bounds[2], bounds[3]
    s, low, high = state[0], state[1], state[2]
    for j in range(len(s)):
        s[j] += share * step[0, j]
        middle = has_low[j] * barrier / (s[j] - lower[j])
        low[j] = min(max(low[j] + share_dual * step[1, j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
        middle = has_high[j] * barrier / (upper[j] - s[j])
        high[j] = min(max(high[j] + share_dual * step[2, j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
