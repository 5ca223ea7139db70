"""On-board go-to: the polynomial by which the high-level commander flies to a place, and stops made with it.

From any state of its own (position p, velocity v, acceleration a, of x, y, z and yaw) the commander plans a polynomial
of degree 7 to a rest at the target; its jerk is zero at both ends (src/modules/src/planner.c, plan_go_to_from, and
pptraj.c, poly4d_set_no_jerk). With u = t/T from 0 to 1:

    x(u) = p + vT u + ½aT² u² + c₄u⁴ + c₅u⁵ + c₆u⁶ + c₇u⁷

A stop flies to the target with the least integral of squared jerk: p + ½ vT + 5/56 aT², but turns less than half way
round.
"""

from math import factorial

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.on_board.pieces import body_rates
from cfplan.flight.setpoints.encoding import controller_attitude
from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import about_z, quaternions_of

MOST_TURN = 3.0  # rad, of a stop; beyond half a turn the firmware would turn the other way round
STOP_DURATION = 1.0  # s
"""From 2 m/s the vehicle brakes at 3.8 m/s² and stops within 1 m; on all of flights/ this keeps the limits of stops."""
_ORDERS = 5  # position to snap
_UPPER = np.linalg.inv(np.array([[1, 1, 1, 1], [4, 5, 6, 7], [12, 20, 30, 42], [24, 60, 120, 210]], dtype=float))


def go_to_states(begin: NDArray, target: NDArray, duration: float, count: int) -> NDArray:
    """Return (K, count, 5, 4): x, y, z and yaw with four derivatives, of K go-tos at even moments, both ends included.

    `begin` (K, 3, 4) is the commander's state with two derivatives, `target` (K, 4) in m and rad; `duration` in s.
    """
    begin = np.array(begin, dtype=float)
    begin[:, 2, 3] = 0.0  # the firmware plans yaw without its acceleration
    lower = begin * (duration ** np.arange(3) / np.array([1.0, 1.0, 2.0]))[:, None]
    position, velocity, acceleration = lower[:, 0], lower[:, 1], lower[:, 2]
    left = np.stack(
        [
            target - position - velocity - acceleration,
            -velocity - 2.0 * acceleration,
            -2.0 * acceleration,
            np.zeros_like(position),
        ],
        axis=1,
    )
    table = np.concatenate([lower, np.zeros_like(lower[:, :1]), np.einsum("ij,kja->kia", _UPPER, left)], axis=1)
    share = np.linspace(0.0, 1.0, count)
    out = np.zeros((len(begin), count, _ORDERS, 4))
    for order in range(_ORDERS):
        for power in range(order, 8):
            rise = factorial(power) / factorial(power - order) * share ** (power - order) / duration**order
            out[:, :, order] += rise[:, None] * table[:, power, None]
    return out


def stop_targets(begin: NDArray, duration: float = STOP_DURATION) -> NDArray:
    """Return where stops from K states, (K, 3, 4), end: (K, 4) in m and rad."""
    begin = np.array(begin, dtype=float)
    begin[:, 2, 3] = 0.0
    way = 0.5 * duration * begin[:, 1] + 5.0 / 56.0 * duration**2 * begin[:, 2]
    way[:, 3] = np.clip(way[:, 3], -MOST_TURN, MOST_TURN)
    return np.asarray(begin[:, 0] + way)


def motion_of(states: NDArray, airframe: Airframe) -> FullStateSetpoints:
    """Return the motion of states, (N, 5, 4), as setpoints: N rows, with drag compensation in the acceleration."""
    velocity, acceleration, yaw = states[:, 1, :3], states[:, 2, :3], states[:, 0, 3]
    pushed = acceleration + airframe.drag[0] / airframe.mass * velocity
    attitude = controller_attitude(pushed + np.array([0.0, 0.0, GRAVITY]), about_z(yaw))
    return FullStateSetpoints(
        position=states[:, 0, :3],
        velocity=velocity,
        acceleration=pushed,
        quaternion=quaternions_of(attitude),
        body_rate=body_rates(acceleration, states[:, 3, :3], yaw, states[:, 1, 3]),
    )
