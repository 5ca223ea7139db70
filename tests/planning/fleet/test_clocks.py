"""The fastest clock ends when a plain search from state to state says it can, and keeps out of hazards."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.planning.fleet.clocks import CELL, LEVELS, RAMP, TICK, Stuck, cells_of, fastest_clock

NO_OTHERS = np.zeros((0, 1, 1, 2))  # (K, T, W, 2) m for K = 0 other vehicles


@st.composite
def maps(draw):
    """Draw a hazard map of up to five rectangles, (T, U), and the ticks at which the vehicle may start, (T,)."""
    cells = len(cells_of(draw(st.floats(0.05, 1.2))))
    ticks = draw(st.integers(2, 50))
    hazard = np.zeros((ticks, cells), dtype=np.bool_)
    for _ in range(draw(st.integers(0, 5))):
        t, u = draw(st.integers(0, ticks - 1)), draw(st.integers(0, cells - 1))
        hazard[t : t + draw(st.integers(1, 30)), u : u + draw(st.integers(1, 40))] = True
    may_start = np.array(draw(st.lists(st.booleans(), min_size=ticks, max_size=ticks)))
    return hazard, may_start


def changes(level, change):
    """Return the cells passed by each tick of a linear change of rate, halves rounded up."""
    return [int(np.floor(level * k + change * k * k / (2 * RAMP) + 0.5)) for k in range(1, RAMP + 1)]


def earliest_end(hazard, may_start):
    """Return the first tick at which the vehicle can rest at its end, following each clock; None if there is none."""
    known, cells = hazard.shape
    end, longest = cells - LEVELS, known + cells + LEVELS * RAMP

    def free(t, u):
        return not hazard[min(t, known - 1), u]

    starts, t = [], 0
    while t < longest and free(t, 0):
        if may_start[min(t, known - 1)]:
            starts += [(t, 0, level) for level in range(1, LEVELS + 1)]
        t += 1
    seen, pending, ends = set(starts), starts, []
    while pending:
        t, u, level = pending.pop()
        if u >= end:
            if all(free(later, end) for later in range(t, max(t, known) + 1)):
                ends.append(t)
            continue
        ways = [(1, u + level, level)] if free(t + 1, u + level) else []
        for change in (-1, 1):
            cells_on_the_way = [u + passed for passed in changes(level, change)]
            if (
                1 <= level + change <= LEVELS
                and cells_on_the_way[-1] <= end
                and all(free(t + k, cell) for k, cell in enumerate(cells_on_the_way, 1))
            ):
                ways.append((RAMP, cells_on_the_way[-1], level + change))
        for ticks, cell, new in ways:
            state = (t + ticks, cell, new)
            if state not in seen and state[0] <= longest:
                seen.add(state)
                pending.append(state)
    return min(ends, default=None)


@settings(max_examples=40)  # the plain search is slow
@given(maps())
def test_no_clock_ends_earlier_and_none_is_missed(drawn):
    hazard, may_start = drawn
    expected = earliest_end(hazard, may_start)
    clock = fastest_clock(np.zeros((hazard.shape[1], 2)), NO_OTHERS, 0.3, hazard, may_start)
    if isinstance(clock, Stuck):
        assert expected is None
    else:
        assert len(clock.own) - 1 == expected


@given(maps())
def test_a_clock_keeps_out_of_the_hazards_and_its_rate_is_its_slope(drawn):
    hazard, may_start = drawn
    clock = fastest_clock(np.zeros((hazard.shape[1], 2)), NO_OTHERS, 0.3, hazard, may_start)
    if isinstance(clock, Stuck):
        return
    ticks = np.arange(len(clock.own))
    assert not hazard[np.minimum(ticks, len(hazard) - 1), clock.own].any()
    assert clock.own[0] == 0
    assert clock.own[-1] >= hazard.shape[1] - LEVELS
    begins = round(clock.delay / TICK)
    assert may_start[min(begins, len(may_start) - 1)]
    mean_rate = (clock.rate[begins + 1 :] + clock.rate[begins:-1]) / 2
    passed = np.cumsum(mean_rate) * TICK / CELL
    assert np.abs(clock.own[begins + 1 :] - passed).max() <= 0.5 + 1e-9  # cells are integers
