"""What must hold at one point of a path, and what it costs, as CasADi expressions.

Everything physical at a point follows from h and yaw with their derivatives there, kept in node units (s counted in
grid steps, h over a scale), which makes the expressions the same for every path and every N:

    given yaw   (x, x', x'', x''')                      h = scale · x
    free yaw    (x, x', x'', x''', ψ, ψ', ψ'')

Path, airframe and limits are arguments, so the same compiled functions serve every problem. Rows of constraints are
those of the table of limited quantities (safety/quantities.py) but for the speed, which h alone decides.
"""

from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from cfplan.safety import quantities
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle import measures
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.flatness import Body, flat_state

ROWS = measures.SPEED  # all measures before it
LOWER, UPPER, JUMPS = quantities.LOWER[:ROWS], quantities.UPPER[:ROWS], quantities.JUMPS[:ROWS]

POINT_DATA = 17  # γ' to γ'''' (12), place in the interval 0 to 1, weight of the penalties, ψ, ψ', ψ''
COMMON_DATA = 9 + 2 * measures.MEASURES  # the airframe (8), scale; offset and scale of each row of the table
PLACE, WEIGHT, YAW = 12, 13, 14  # rows of the point data
LEAST = 1e-6  # x below this counts as this: a solver that tries h < 0 must not meet what is not a number
UNBOUNDED = 1e8  # stands for no limit, in a row's own unit


@dataclass(frozen=True, slots=True)
class Penalties:
    """What a second of flight costs beyond its time; keeps solutions smooth and yaw from drifting."""

    angular_acceleration: float = 1e-6  # s⁴/rad², per squared angular acceleration
    yaw_rate: float = 1e-2  # s²/rad², per squared yaw rate; free yaw only
    roughness: float = 1e-3  # s, per squared third derivative of h over h, in grid steps, an interval

    def weights(self) -> tuple[float, float, float]:
        """Return what point_expressions takes."""
        return self.angular_acceleration, self.yaw_rate, self.roughness


def common_data(airframe: Airframe, limits: PlanLimits, scale: float) -> NDArray:
    """Return (COMMON_DATA,), the same at every point; `scale` turns x into h in node units."""
    offsets, scales = quantities.scales(limits)
    return np.concatenate([
        [airframe.mass, *airframe.inertia, airframe.arm, airframe.thrust_to_torque, *airframe.drag, scale],
        offsets, np.minimum(scales, UNBOUNDED),
    ])  # fmt: skip


def point_expressions(free_yaw: bool) -> tuple[list[casadi.SX], casadi.SX, casadi.SX]:
    """Return ([variables, point data, common data, penalty weights], constraint rows, penalty)."""
    z = casadi.SX.sym("z", variables(free_yaw))
    point = casadi.SX.sym("point", POINT_DATA)
    common = casadi.SX.sym("common", COMMON_DATA)
    weights = casadi.SX.sym("weights", 3)

    values: list[Any] = casadi.vertsplit(common)
    (mass, jx, jy, jz, arm, thrust_to_torque, drag, axial_drag, scale), limits = values[:9], values[9:]
    data: list[Any] = casadi.vertsplit(point)
    derivatives: Any = tuple(tuple(data[3 * k : 3 * k + 3]) for k in range(4))
    local: list[Any] = casadi.vertsplit(z)
    x, yaw = [casadi.fmax(local[0], LEAST), *local[1:4]], local[4:] if free_yaw else data[YAW:]
    h: Any = tuple(scale * value for value in x)
    body = Body(mass, (jx, jy, jz), arm, thrust_to_torque, (drag, axial_drag))
    measured = measures.measures(flat_state(body, derivatives, h, tuple(yaw), casadi.cos, casadi.sin))
    rows: list[Any] = quantities.rows_of(measured, limits[: len(measured)], limits[len(measured) :])[:ROWS]

    penalty: Any = weights[0] * measured[measures.ANGULAR_ACCELERATION]
    if free_yaw:
        penalty += weights[1] * h[0] * yaw[1] ** 2
    penalty = penalty / casadi.sqrt(h[0]) + weights[2] * (x[3] / x[0]) ** 2
    bounded: Any = casadi.vertcat(*rows)
    return [z, point, common, weights], bounded, data[WEIGHT] * penalty


def variables(free_yaw: bool) -> int:
    """Return how many numbers decide a point, and how many spline coefficients those."""
    return 7 if free_yaw else 4


def family(free_yaw: bool) -> str:
    """Return the name of the functions' family."""
    return "free" if free_yaw else "given"
