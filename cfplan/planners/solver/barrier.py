"""Slacks of constraints between bounds, the multipliers of those bounds, and the barrier that keeps slacks inside.

Arrays of (m,) lie together as rows: bounds, a state that a search changes, a step of it, and what constraints then pull
with (PULLS). A bound that is not there lies far away and has no barrier, so that all constraints go through the same
arithmetic, several at a time.
"""

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit

PULLS = ("stiffness", "multiplier", "wall", "missing")
# of each constraint, by row: Σ of its slack; y; the slope of a barrier of 1 there; Σ times what it is off its slack
FAR = 1e20
COMPLEMENTARY = 1e10
# how far a multiplier may be from what the barrier makes of its slack, as a factor

_SUMS = {"contract", "reassoc", "nsz", "arcp"}  # freedom that what is not a number survives
_LANES = 16  # numbers that the compiler may want to compare at once


@njit
def bounds_of(lower: NDArray, upper: NDArray) -> NDArray:
    """(5, m) lower and upper bound, whether each is there, and whether either is."""
    bounds = np.empty((5, len(lower)))
    for j in range(len(lower)):
        has_low, has_high = lower[j] > -np.inf, upper[j] < np.inf
        bounds[0, j], bounds[1, j] = lower[j] if has_low else -FAR, upper[j] if has_high else FAR
        bounds[2, j], bounds[3, j], bounds[4, j] = has_low, has_high, has_low or has_high
    return bounds


@njit(error_model="numpy")
def first(g, bounds, barrier, push, state, pulls):
    """Slacks where the constraints are, but inside by `push` of the span between bounds at least; multipliers that the
    barrier makes of them. Fills in the pulls too.

    Slacks that start next to a bound would hold back every step: better to start a little off the constraints.
    """
    for j in range(len(g)):
        lower, upper, active = bounds[0, j], bounds[1, j], bounds[4, j]
        room = push * min(upper - lower, 2.0)
        s = min(max(g[j], lower + room), upper - room)
        by_below, by_above = bounds[2, j] / (s - lower), bounds[3, j] / (upper - s)
        low, high = barrier * by_below, barrier * by_above
        stiffness = low * by_below + high * by_above
        state[0, j], state[1, j], state[2, j] = s, low, high
        pulls[0, j], pulls[1, j] = stiffness, high - low
        pulls[2, j], pulls[3, j] = by_above - by_below, active * stiffness * (g[j] - s)


@register_jitable
def _largest(values):
    """The largest of non-negative numbers. The compiler would compare one by one, as it may not change the order."""
    most, whole = np.zeros(_LANES), len(values) - len(values) % _LANES
    for begin in range(0, whole, _LANES):
        for lane in range(_LANES):
            value = values[begin + lane]
            most[lane] = value if value > most[lane] else most[lane]
    largest = 0.0
    for value in most:
        largest = max(largest, value)
    for value in values[whole:]:
        largest = max(largest, value)
    return largest


@njit(error_model="numpy", fastmath=_SUMS)
def errors(g, bounds, state, barrier):
    """The largest |g - s|, and the largest difference of a slack's product from the barrier. For finite numbers."""
    lower, upper, has_low, has_high, active = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, low, high = state[0], state[1], state[2]
    infeasible, off = np.empty(len(s)), np.empty(len(s))
    for j in range(len(s)):
        infeasible[j] = active[j] * abs(g[j] - s[j])
        below = abs(low[j] * (s[j] - lower[j]) - has_low[j] * barrier)
        above = abs(high[j] * (upper[j] - s[j]) - has_high[j] * barrier)
        off[j] = below if below > above else above
    return _largest(infeasible), _largest(off)


@njit(error_model="numpy", fastmath=_SUMS)
def steps(g, along, bounds, state, barrier, most, step):
    """Fill in the step, where g changes by `along`.

    Gives (slope of the barrier along it, longest share of it that leaves (1 - most) of the room, the same for
    multipliers). For finite numbers.
    """
    lower, upper, has_low, has_high, active = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, low, high = state[0], state[1], state[2]
    ds, dlow, dhigh = step[0], step[1], step[2]
    slope, fastest, fastest_dual = 0.0, np.empty(len(s)), np.empty(len(s))
    for j in range(len(s)):
        below, above = s[j] - lower[j], upper[j] - s[j]
        inverse = 1.0 / (below * above)  # divisions take longest
        by_below, by_above = above * inverse, below * inverse
        d = active[j] * (g[j] - s[j] + along[j])
        ds[j] = d
        slope += (has_high[j] * by_above - has_low[j] * by_below) * d
        fastest[j] = d * by_above if d > 0.0 else -d * by_below
        dl = (has_low[j] * barrier - low[j] * d) * by_below - low[j]
        dh = (has_high[j] * barrier + high[j] * d) * by_above - high[j]
        dlow[j], dhigh[j] = dl, dh
        its_low, its_high = low[j] + (1.0 - has_low[j]), high[j] + (1.0 - has_high[j])
        inverse = 1.0 / (its_low * its_high)
        of_low, of_high = -dl * its_high * inverse, -dh * its_low * inverse
        fastest_dual[j] = of_low if of_low > of_high else of_high
    share, share_dual = most / max(_largest(fastest), 1e-30), most / max(_largest(fastest_dual), 1e-30)
    return barrier * slope, min(1.0, share), min(1.0, share_dual)


@njit(error_model="numpy", fastmath=_SUMS)
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


@njit(error_model="numpy", fastmath=_SUMS)
def advance(g, bounds, state, step, share, share_dual, barrier, pulls):
    """Take the step, in place, and fill in the pulls where g is now; gives the errors there.

    Multipliers stay within a factor of what the barrier makes of their slacks.
    """
    lower, upper, has_low, has_high, active = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, low, high = state[0], state[1], state[2]
    ds, dlow, dhigh = step[0], step[1], step[2]
    stiffness, multiplier, wall, missing = pulls[0], pulls[1], pulls[2], pulls[3]
    infeasible, off = np.empty(len(s)), np.empty(len(s))
    for j in range(len(s)):
        there = s[j] + share * ds[j]
        below, above = there - lower[j], upper[j] - there
        inverse = 1.0 / (below * above)
        by_below, by_above = has_low[j] * above * inverse, has_high[j] * below * inverse
        middle = barrier * by_below
        of_low = min(max(low[j] + share_dual * dlow[j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
        middle = barrier * by_above
        of_high = min(max(high[j] + share_dual * dhigh[j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
        s[j], low[j], high[j] = there, of_low, of_high
        by_slack = of_low * by_below + of_high * by_above
        missed = active[j] * (g[j] - there)
        stiffness[j], multiplier[j] = by_slack, of_high - of_low
        wall[j], missing[j] = by_above - by_below, by_slack * missed
        infeasible[j] = abs(missed)
        below = abs(of_low * (there - lower[j]) - has_low[j] * barrier)
        above = abs(of_high * (upper[j] - there) - has_high[j] * barrier)
        off[j] = below if below > above else above
    return _largest(infeasible), _largest(off)
