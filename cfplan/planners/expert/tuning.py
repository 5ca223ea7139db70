"""Parameters of the expert, tuned by measurement: `python -m studies planners` shows their effect.

Its results are results/planners-random.json, planners-hard.json, planners-lengths.json and planners-drawn.json: flight
times, rates of success and planning times, by kind of path. Lengths are in intervals unless stated otherwise.
"""

from typing import NamedTuple


class WindowSize(NamedTuple):
    """How many intervals of a path are planned at once."""

    kept: int
    ahead: int  # beyond those, planned and not kept


class Penalties(NamedTuple):
    """Penalties per second of flight, which keep solutions smooth and yaw from drifting."""

    angular_acceleration: float = 1e-6  # s⁴/rad², per squared angular acceleration
    yaw_rate: float = 1e-2  # s²/rad², per squared yaw rate; free yaw only
    roughness: float = 1e-3  # s, per squared third derivative of h over h, in grid steps, an interval


class Guess(NamedTuple):
    """Parameters of the initial guess, initial_guess.py."""

    highest: float = 6.0  # h at most, where the path nearly stands still, in squares of the speed limit
    usage: float = 0.7  # of each limit
    smoothing: float = 2.0
    h_blend: float = 5.0  # over which h comes away from a boundary state: in fewer it jerks, in more it cannot brake
    yaw_blend: float = 4.0
    lowered_from: int = 3  # coefficients from a held end, where h begins to be lowered
    lowered_to: int = 10  # and from which it is lowered fully; on a fine grid, where these pass quickly,
    lowered_time: float = 0.15  # s, after as many as take this time


class Tuning(NamedTuple):
    """The parameters, grouped by purpose; a NamedTuple, as compiled functions read it."""

    penalties: Penalties = Penalties()
    guess: Guess = Guess()

    # Limits at points, problem.py
    margin: float = 1e-3  # fraction by which limits are tightened, for excesses between points
    blend: int = 5  # over which that margin grows from zero, next to a boundary state, which may lie at a limit
    joint_margin: float = 0.01  # likewise around a joint, so that the next window has room
    around_joint: int = 6  # over how many on each side
    boundary_tolerance: float = 0.1  # by which rows that a checked boundary state alone decides may exceed limits
    overtightening: float = 1.5  # times a violation between points, by which limits are lowered: peaks fall by less
    ceiling: float = 20.0  # h at most, where the path nearly stands still, in squares of the speed limit
    floor: float = 1e-4  # coefficients of x at least
    speed_cap_ratio: float = 4.0  # times a flight's typical speed, above which a speed limit is too far off to scale by

    # Tightening, expert.py; the places between points, intersample.py
    rounds: int = 5  # at most
    allowance: float = 1.5e-3  # of the rows, kept free: certificates allow for their own sampling
    thrust_allowance: float = 4e-3  # likewise, of thrusts, which change fastest
    fine_allowance: float = 5e-3  # likewise in refined intervals
    enough: float = 5e-4  # violation of the allowance at which tightening ends, unless limits leave room
    places: int = 17  # in an interval
    fine_places: int = 65  # in refined intervals: at the ends, where the thrust axis may swing, and in sharp turns
    refined_at_ends: int = 4
    sharp: float = 0.25  # rad of turn in an interval, above which it is refined

    # Where the search stops, expert.py
    stop_barrier: float = 0.15  # for each second that an interval takes: within about 0.02 % of the optimum
    stop_feasibility: float = 2e-4  # what remains of the constraints is a fraction of `margin`
    stop_gradient: float = 0.05
    predicted_gradient_factor: float = 0.2  # of the gradient after a full step; it leaves less than a tenth
    loose_factor: float = 10.0  # times that much may remain before limits are tightened
    least_step: float = 3e-3  # fraction of a step, below which a search from a guess is abandoned: 1 of 217 that
    # succeeded had a shorter one, of 164 that failed all, and these end after half as many steps

    # Where the search begins, expert.py
    first_barrier_factor: float = 3.0  # times the last: with the last one, a search from far off stalls at its bounds
    first_multipliers: float = 10.0  # times those of the last barrier: limits are fully used
    fallback_barrier_factor: float = 8.0  # 0.3 % from the optimum: for a search that does not end otherwise, and under
    # caps, which giving way finds step by step: from profiles at their limits it finds lower ones
    initial_h_reduction: float = 0.1  # fraction of h that refining begins below: constraints begin inside their bounds
    stall_iterations: int = 16  # after which a search may have stalled 3 % from the optimum, and is continued once

    # Windows, windows.py
    window: WindowSize = WindowSize(kept=96, ahead=24)  # longer windows take more iterations
    early_window: WindowSize = WindowSize(kept=224, ahead=32)  # of searches that stop early
    lookahead: float = 2.5  # m beyond twice the braking distance: attitude takes time to turn, and curves leave little
    # acceleration to brake with. Windows then fail on 2 of 160 paths of 40 to 100 m; with 0.5 m they fail on 8

    # Whether a motion can continue, expert.py
    beginning: float = 0.6  # s within which that is decided
    least_beginning: int = 12


TUNING = Tuning()
