"""The fastest clock, against a search that marks one state after another."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.planning.fleet.clocks import CELL, LEVELS, RAMP, TICK, Stuck, cells_of, fastest_clock

ANYWHERE = np.zeros((0, 1, 1, 2))  # columns of no other vehicles


@st.composite
def maps(draw):
    """The cells of a plan, and a map of hazards of some rectangles with the ticks at which the vehicle may start."""
    cells = len(cells_of(draw(st.floats(0.05, 1.2))))
    ticks = draw(st.integers(2, 50))
    hazard = np.zeros((ticks, cells), dtype=np.bool_)
    for _ in range(draw(st.integers(0, 5))):
        t, u = draw(st.integers(0, ticks - 1)), draw(st.integers(0, cells - 1))
        hazard[t : t + draw(st.integers(1, 30)), u : u + draw(st.integers(1, 40))] = True
    may_start = np.array(draw(st.lists(st.booleans(), min_size=ticks, max_size=ticks)))
    return hazard, may_start


def changes(level, change):
    """The cells passed at each tick of a change of rate, which is linear in time; halves are rounded up."""
    return [int(np.floor(level * k + change * k * k / (2 * RAMP) + 0.5)) for k in range(1, RAMP + 1)]


def earliest_end(hazard, may_start):
    """The first tick at which a vehicle may rest at its end, by following each clock from state to state; or None."""
    known, cells = hazard.shape
    end, longest = cells - LEVELS, known + cells + LEVELS * RAMP

    def free(t, u):
        return not hazard[min(t, known - 1), u]

    starts, t = [], 0
    while t < longest and free(t, 0):
        if may_start[min(t, known - 1)]:
            starts += [(t, 0, level) for level in range(1, LEVELS + 1)]
        t += 1
    seen, following, ends = set(starts), starts, []
    while following:
        t, u, level = following.pop()
        if u >= end:
            if all(free(later, end) for later in range(t, known + 1)):
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
                following.append(state)
    return min(ends, default=None)


@settings(max_examples=40)  # it takes its time
@given(maps())
def test_no_clock_ends_earlier_and_none_is_missed(drawn):
    hazard, may_start = drawn
    expected = earliest_end(hazard, may_start)
    clock = fastest_clock(np.zeros((hazard.shape[1], 2)), ANYWHERE, 0.3, hazard, may_start)
    if isinstance(clock, Stuck):
        assert expected is None
    else:
        assert len(clock.own) - 1 == expected


@given(maps())
def test_a_clock_keeps_out_of_the_hazards_and_its_rate_is_its_slope(drawn):
    hazard, may_start = drawn
    clock = fastest_clock(np.zeros((hazard.shape[1], 2)), ANYWHERE, 0.3, hazard, may_start)
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
    assert np.abs(clock.own[begins + 1 :] - passed).max() <= 0.5 + 1e-9  # cells are whole
