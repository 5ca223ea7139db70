"""Dry run of on-board pieces: polynomials flown by the simulated vehicle as its high-level commander flies them.

It starts in hover where they begin. The commander evaluates the decoded pieces 100 times a second, and passes the
controller position, velocity, acceleration, yaw and body rates. Otherwise it is the dry run of streamed setpoints.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.on_board.certified_pieces import OnBoardTrajectory
from cfplan.flight.on_board.pieces import RATE, Pieces, goals_at
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import SETTLING, DryRun, Rehearsed, rehearse_draws
from cfplan.simulation.engine.layout import SETPOINT_SIZE
from cfplan.simulation.engine.mellinger import ON_BOARD


def on_board_run(flight: OnBoardTrajectory, limits: Limits) -> DryRun:
    """Fly the pieces, then hover for SETTLING s; deviations are from the plan, slowed like them."""
    pieces = flight.pieces
    times = np.arange(int(np.ceil((pieces.duration + SETTLING) * RATE))) / RATE
    rows = goal_rows(pieces, times)

    def wanted_at(times: NDArray) -> NDArray:
        return flight.reference.plan_at(times)[:, 0, :3]

    duration = pieces.duration + SETTLING
    return rehearse_draws(
        Rehearsed(rows, times, float(rows[0, 18]), wanted_at, pieces.duration, duration, ON_BOARD), limits
    )  # fmt: skip


def goal_rows(pieces: Pieces, times: NDArray) -> NDArray:
    """Return (N, 20): the commander's goals for the controller at times, (N,) s, as `mellinger` has setpoints."""
    goals = goals_at(pieces, times)
    rows = np.zeros((len(times), SETPOINT_SIZE))
    rows[:, 0:3], rows[:, 3:6], rows[:, 6:9] = goals.position, goals.velocity, goals.acceleration
    rows[:, 13:16], rows[:, 18] = goals.body_rate, goals.yaw
    return rows
