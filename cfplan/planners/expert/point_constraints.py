"""Point constraints: the rows that must hold at one point of a path, and the data that they depend on.

Rows are those of the table of limited quantities (safety/quantities.py) except the speed, which depends on h alone.
Path, airframe and limits are data, so that the same compiled functions (kernel.py) serve every problem.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.safety import quantities
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle import measures
from cfplan.vehicle.airframe import Airframe

ROWS = measures.SPEED  # all measures before it
LOWER, UPPER, JUMPS = quantities.LOWER[:ROWS], quantities.UPPER[:ROWS], quantities.JUMPS[:ROWS]

POINT_DATA = 17  # γ' to γ'''' (12), place in the interval 0 to 1, weight of the penalties, ψ, ψ', ψ''
COMMON_DATA = 11 + 2 * measures.MEASURES  # the airframe (10), scale; offset and scale of each row of the table
PLACE, WEIGHT, YAW = 12, 13, 14  # rows of the point data
LANES = 8  # points come in multiples of this, so that kernels can process several with one instruction
LEAST = 1e-6  # lower bound of x in the constraints: a solver that tries h < 0 must not meet NaN
UNBOUNDED = 1e8  # stands for no limit, in a row's own unit


def common_data(airframe: Airframe, limits: PlanLimits, scale: float) -> NDArray:
    """Return (COMMON_DATA,), the same at every point; `scale` turns x into h in node units."""
    offsets, scales = quantities.scales(limits)
    return np.concatenate([
        [airframe.mass, *airframe.inertia, airframe.arm, airframe.thrust_to_torque, *airframe.drag],
        [*airframe.velocity_moment, scale],
        offsets, np.minimum(scales, UNBOUNDED),
    ])  # fmt: skip


def variables(free_yaw: bool) -> int:
    """Return how many spline coefficients determine a point; as many values of h and yaw follow from them."""
    return 7 if free_yaw else 4
