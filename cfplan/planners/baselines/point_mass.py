"""The fastest flight of a point mass through waypoints: a time that no vehicle with these limits beats.

The point mass keeps the limits on speed and acceleration; it has no attitude and no motors, and knows no walls.
Accelerations are constant within equal parts of each segment, so that its motion follows exactly from them; finer
parts lower the time by less than a thousandth. IPOPT finds the times and accelerations together.
"""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.geometry.waypoints import Gate, Region, Within
from cfplan.safety.limits import PlanLimits

PARTS = 32  # of a segment
MOST_WAYPOINTS = 40  # with more it would take longer than planning


def point_mass_time(
    waypoints: ArrayLike, limits: PlanLimits, regions: tuple[Region, ...] = (), parts: int = PARTS
) -> float | None:
    """Return the least time, s, of a point mass through waypoints, (K, 3) m, from rest to rest; None if none is found.

    With `regions`, K of them, it may pass the waypoints anywhere within these. Also None for more than
    MOST_WAYPOINTS.
    """
    import casadi as ca  # slow to import

    points = np.asarray(waypoints, dtype=float)
    if len(points) > MOST_WAYPOINTS:
        return None
    legs = len(points) - 1
    steps = legs * parts
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    times, acceleration = ca.SX.sym("times", legs), ca.SX.sym("acceleration", 3, steps)
    position, velocity = ca.SX.sym("position", 3, steps + 1), ca.SX.sym("velocity", 3, steps + 1)
    step = ca.reshape(ca.repmat(times.T / parts, 3 * parts, 1), 3, steps)
    moved = position[:, :-1] + step * velocity[:, :-1] + 0.5 * step**2 * acceleration
    at = position[:, np.arange(legs + 1) * parts] - points.T
    kept, most = _around(ca, at, regions or (None,) * len(points))
    rows = ca.vertcat(
        ca.vec(position[:, 1:] - moved),
        ca.vec(velocity[:, 1:] - velocity[:, :-1] - step * acceleration),
        velocity[:, 0], velocity[:, -1],
        ca.vec(ca.sum1(velocity**2)) / limits.speed**2, ca.vec(ca.sum1(acceleration**2)) / limits.acceleration**2,
        kept,
    )  # fmt: skip
    equations = 6 * steps + 6
    least = np.concatenate([np.zeros(equations), np.full(2 * steps + 1, -np.inf), -most])
    largest = np.concatenate([np.zeros(equations), np.ones(2 * steps + 1), most])
    program = {"x": ca.veccat(times, acceleration, position, velocity), "f": ca.sum1(times), "g": rows}
    solver = ca.nlpsol("point_mass", "ipopt", program, {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}})
    guess = lengths / limits.speed + 2.0 * np.sqrt(lengths / limits.acceleration)
    along = np.concatenate([
        *(np.linspace(a, b, parts, endpoint=False) for a, b in pairwise(points)), points[-1:]
    ])  # fmt: skip
    speeds = np.repeat(np.diff(points, axis=0) / guess[:, None], parts, axis=0)
    start = np.concatenate([guess, np.zeros(3 * steps), along.ravel(), speeds.ravel(), np.zeros(3)])
    floor = np.concatenate([np.full(legs, 1e-3), np.full(len(start) - legs, -np.inf)])
    answer = solver(x0=start, lbx=floor, lbg=least, ubg=largest)
    return float(answer["f"]) if solver.stats()["success"] else None


def _around(ca: Any, at: Any, regions: tuple[Region, ...]) -> tuple[Any, NDArray]:
    """Return rows that hold positions relative to the waypoints, (3, K), within regions, and their largest values."""
    rows, most = [], []
    for k, region in enumerate(regions):
        match region:
            case Within(radius):
                rows.append(ca.sumsqr(at[:, k]) / radius**2)
                most.append([1.0])
            case Gate():
                across, up = region.half_axes(0.0)
                rows += [ca.dot(region.forwards, at[:, k]), ca.dot(across, at[:, k]), ca.dot(up, at[:, k])]
                most.append([0.0, float(across @ across), float(up @ up)])
            case None:
                rows.append(at[:, k])
                most.append([0.0, 0.0, 0.0])
    return ca.vertcat(*rows), np.concatenate(most)
