"""The barrier method's slacks, multipliers and steps, for constraints between bounds.

Each constraint g has a slack s, with lower ≤ s ≤ upper, and a multiplier of each bound. Arrays of (m,) constraints lie
together as rows:

    bounds  (5, m)   lower bound, upper bound, whether there is a lower one, an upper one, either
    slacks  (3, m)   slack, multiplier of its lower bound, of its upper bound
    step    (3, m)   a change of these
    terms   (4, m)   TERMS: what the Newton step needs of each constraint

A missing bound lies far away and has no barrier, so that all constraints go through the same arithmetic, several at a
time. No public function changes its arguments.
"""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit

TERMS = ("sigma", "multiplier", "barrier", "residual")
# Of each constraint, by row: Σ, the curvature that its slack's barrier adds; the multiplier y of g; the slope of a
# barrier of weight 1 at the slack; and Σ (g - s).
FAR = 1e20
COMPLEMENTARY = 1e10  # factor within which a multiplier stays of the one that the barrier prescribes for its slack

# Freedom in the order of sums that lets NaN survive.
_SUMS = {"contract", "reassoc", "nsz", "arcp"}
_LANES = 16  # numbers that the processor may compare at once


class Errors(NamedTuple):
    """The distance of slacks and multipliers from the solution of the barrier problem."""

    infeasibility: float  # the largest |g - s|
    complementarity: float  # the largest difference of a slack's product with its multiplier from the barrier


class SearchDirection(NamedTuple):
    """A step of slacks and multipliers, and the step lengths that keep them inside."""

    step: NDArray  # (3, m)
    slope: float  # of the barrier along it
    alpha_primal: float  # step length of the slacks, at most 1
    alpha_dual: float  # step length of the multipliers, at most 1


@njit
def bounds_of(lower: NDArray, upper: NDArray) -> NDArray:
    """Return the bounds, (5, m), of (m,) lower and upper ones, infinite where there is none."""
    bounds = np.empty((5, len(lower)))
    for j in range(len(lower)):
        has_low, has_high = lower[j] > -np.inf, upper[j] < np.inf
        bounds[0, j], bounds[1, j] = lower[j] if has_low else -FAR, upper[j] if has_high else FAR
        bounds[2, j], bounds[3, j], bounds[4, j] = has_low, has_high, has_low or has_high
    return bounds


@njit(error_model="numpy")
def initialise(g, bounds, barrier, push):
    """Return (slacks, terms): slacks where g is, but inside by `push` of the span between bounds at least.

    Slacks that start next to a bound would hold back every step: better to start a little off the constraints.
    """
    slacks, terms = np.empty((3, len(g))), np.empty((4, len(g)))
    for j in range(len(g)):
        lower, upper, bounded = bounds[0, j], bounds[1, j], bounds[4, j]
        room = push * min(upper - lower, 2.0)
        s = min(max(g[j], lower + room), upper - room)
        by_below, by_above = bounds[2, j] / (s - lower), bounds[3, j] / (upper - s)
        low, high = barrier * by_below, barrier * by_above
        sigma = low * by_below + high * by_above
        slacks[0, j], slacks[1, j], slacks[2, j] = s, low, high
        terms[0, j], terms[1, j] = sigma, high - low
        terms[2, j], terms[3, j] = by_above - by_below, bounded * sigma * (g[j] - s)
    return slacks, terms


@njit(error_model="numpy")
def carried_over(g, bounds, slacks, new):
    """Return (slacks, terms) of a search that ended here, for `new` bounds, (5, m): as far from them as from the old.

    Multipliers stay, so what is left to do is to bring the constraints to where their slacks are now. Where there was
    no bound there is none now.
    """
    after, terms = np.empty((3, len(g))), np.empty((4, len(g)))
    for j in range(len(g)):
        below, above = slacks[0, j] - bounds[0, j], bounds[1, j] - slacks[0, j]
        if new[2, j] > 0.0 and new[3, j] > 0.0:
            span = (new[1, j] - new[0, j]) / (below + above)
            below, above = span * below, span * above
        s = g[j]
        if new[2, j] > 0.0:
            s = new[0, j] + below
        elif new[3, j] > 0.0:
            s = new[1, j] - above
        by_below, by_above = new[2, j] / below, new[3, j] / above
        low, high = slacks[1, j], slacks[2, j]
        sigma = low * by_below + high * by_above
        after[0, j], after[1, j], after[2, j] = s, low, high
        terms[0, j], terms[1, j] = sigma, high - low
        terms[2, j], terms[3, j] = by_above - by_below, new[4, j] * sigma * (g[j] - s)
    return after, terms


@register_jitable
def _largest(values):
    """Return the largest of non-negative numbers.

    Sixteen running maxima let the processor compare as many at once: a single one fixes the order of the comparisons.
    """
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
def errors(g, bounds, slacks, barrier):
    """Return the Errors, of finite numbers."""
    lower, upper, has_low, has_high, bounded = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, low, high = slacks[0], slacks[1], slacks[2]
    infeasible, off = np.empty(len(s)), np.empty(len(s))
    for j in range(len(s)):
        infeasible[j] = bounded[j] * abs(g[j] - s[j])
        below = abs(low[j] * (s[j] - lower[j]) - has_low[j] * barrier)
        above = abs(high[j] * (upper[j] - s[j]) - has_high[j] * barrier)
        off[j] = below if below > above else above
    return Errors(_largest(infeasible), _largest(off))


def search_direction(
    g: NDArray, dg: NDArray, bounds: NDArray, slacks: NDArray, barrier: float, most: float
) -> SearchDirection:
    """Return the SearchDirection where g changes by `dg`; no step takes more than `most` of the room to a bound.

    For finite numbers.
    """
    step = np.empty_like(slacks)  # made here, as compiled code takes longer to hand one out
    return SearchDirection(step, *_search_direction(g, dg, bounds, slacks, barrier, most, step))


@njit(error_model="numpy", fastmath=_SUMS)
def _search_direction(g, dg, bounds, slacks, barrier, most, step):
    """Fill in the step; return the rest of the SearchDirection."""
    lower, upper, has_low, has_high, bounded = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, low, high = slacks[0], slacks[1], slacks[2]
    ds, dlow, dhigh = step[0], step[1], step[2]
    slope, fastest, fastest_dual = 0.0, np.empty(len(s)), np.empty(len(s))
    for j in range(len(s)):
        below, above = s[j] - lower[j], upper[j] - s[j]
        inverse = 1.0 / (below * above)  # divisions take longest
        by_below, by_above = above * inverse, below * inverse
        d = bounded[j] * (g[j] - s[j] + dg[j])
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
def merit_terms(g, bounds, slacks, step, share, barrier, rows):
    """Return (Σ |g - s|, the barrier's cost) after a share of the step.

    g is taken as `rows` rows of as many constraints each, and a rest: a logarithm of a column's product takes less time
    than one of each of its entries.
    """
    lower, upper, has_low, has_high, bounded = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    s, ds = slacks[0], step[0]
    columns = len(g) // rows
    products = np.ones(columns)
    infeasible, total = 0.0, 0.0
    for r in range(rows):
        for c in range(columns):
            j = r * columns + c
            slack = s[j] + share * ds[j]
            infeasible += bounded[j] * abs(g[j] - slack)
            products[c] *= has_low[j] * (slack - lower[j]) + (1.0 - has_low[j])
            products[c] *= has_high[j] * (upper[j] - slack) + (1.0 - has_high[j])
    for c in range(columns):
        total += math.log(products[c])
    for j in range(rows * columns, len(g)):
        slack = s[j] + share * ds[j]
        infeasible += bounded[j] * abs(g[j] - slack)
        total += math.log(has_low[j] * (slack - lower[j]) + (1.0 - has_low[j]))
        total += math.log(has_high[j] * (upper[j] - slack) + (1.0 - has_high[j]))
    return infeasible, -barrier * total


def accept_step(
    g: NDArray, bounds: NDArray, slacks: NDArray, direction: SearchDirection, alpha_primal: float, barrier: float
) -> tuple[NDArray, NDArray, Errors]:
    """Return (slacks, terms, Errors) after a step of length `alpha_primal` of the slacks, which led to g.

    Multipliers take their full step length, and stay within COMPLEMENTARY of those that the barrier prescribes.
    """
    after, terms = np.empty_like(slacks), np.empty((4, len(g)))
    step, alpha_dual = direction.step, direction.alpha_dual
    return after, terms, Errors(*_accept_step(g, bounds, slacks, step, alpha_primal, alpha_dual, barrier, after, terms))


@njit(error_model="numpy", fastmath=_SUMS)
def _accept_step(g, bounds, slacks, step, share, share_dual, barrier, after, terms):
    """Fill in the slacks after the step, and the terms; return the Errors.

    In several loops: the compiler takes several constraints at once only where few arrays are written, as they might
    overlap.
    """
    lower, upper, has_low, has_high, bounded = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    ds, dlow, dhigh = step[0], step[1], step[2]
    s, low, high = slacks[0], slacks[1], slacks[2]
    new_s, new_low, new_high = after[0], after[1], after[2]
    sigma, multiplier, slope, residual = terms[0], terms[1], terms[2], terms[3]
    by_below, by_above = np.empty(len(s)), np.empty(len(s))
    for j in range(len(s)):
        new_s[j] = s[j] + share * ds[j]
    for j in range(len(s)):
        below, above = new_s[j] - lower[j], upper[j] - new_s[j]
        inverse = 1.0 / (below * above)
        by_below[j], by_above[j] = has_low[j] * above * inverse, has_high[j] * below * inverse
    for j in range(len(s)):
        middle = barrier * by_below[j]
        new_low[j] = min(max(low[j] + share_dual * dlow[j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
    for j in range(len(s)):
        middle = barrier * by_above[j]
        new_high[j] = min(max(high[j] + share_dual * dhigh[j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
    for j in range(len(s)):
        curvature = new_low[j] * by_below[j] + new_high[j] * by_above[j]
        sigma[j], multiplier[j] = curvature, new_high[j] - new_low[j]
        slope[j], residual[j] = by_above[j] - by_below[j], curvature * (bounded[j] * (g[j] - new_s[j]))
    infeasible, off = by_below, by_above  # whose memory is no longer needed
    for j in range(len(s)):
        infeasible[j] = abs(bounded[j] * (g[j] - new_s[j]))
        below = abs(new_low[j] * (new_s[j] - lower[j]) - has_low[j] * barrier)
        above = abs(new_high[j] * (upper[j] - new_s[j]) - has_high[j] * barrier)
        off[j] = below if below > above else above
    return _largest(infeasible), _largest(off)
