"""The paper's TOPPQuad as a nonlinear program: its equations as printed, 16 variables at each node.

    h, h', q (4), ω (3), α (3), u (4)           ω and α spatial: per s, not per second

    min Σ 2Δs/(√hᵢ + √hᵢ₊₁) + λ Σ ‖αᵢ‖²,  λ = 1e-4
    hᵢ₊₁ = hᵢ + Δs h'ᵢ                          ωᵢ₊₁ = ωᵢ + Δs αᵢ
    qᵢ₊₁ = (I + ½Δs Ω(ωᵢ)) qᵢ / √(1 + ¼Δs²‖ωᵢ‖²)                                      (Eq. 23)
    m(½γ'h' + γ''h + g e₃) = R(q)e₃ c,  J(½ωh' + αh) + (ω × Jω)h = τ,  [c; τ] = F u   (Eq. 18)
    u, v, a, ω within their bounds; yaw at the start in [0, π/2]

after Mao, Spasojevic, Hsieh and Kumar, "TOPPQuad" (IROS 2024) with the changes of "Sequence Modeling for Time-Optimal
Quadrotor Trajectory Optimization", appendix "Dataset Generation". Added here, because the certificate asks for it: the
airframe's drag (zero drag gives back the equations above), tilt, least specific thrust and angular acceleration.

Rest: at a rest end γ' = γ'' = 0, so the vehicle is level and at rest for any h, and h is free above its lower bound.
Fixing h = 0 there would make it impossible to leave rest, since ω is per s. Body rates at the ends are free
as well: a first step of Eq. 23 from ω = 0 could not tilt the vehicle.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from cfplan.vehicle.airframe import GRAVITY, Airframe

VARIABLES = 16
# A node: 3 force, 3 torque, acceleration², angular velocity², tilt, specific thrust, yaw fixed, yaw at the start,
# angular acceleration² over its limit²
ROWS = 13
STEP_ROWS = 8  # an interval: h, q, ω
H_LEAST = 1e-3
PENALTY = 1e-4  # λ
CACHED_PROBLEMS = 8


@dataclass(frozen=True, slots=True)
class ToppquadNlp:
    """The program in IPOPT. Variables by node; constraints: rows by node, steps, ‖q₀‖² = 1."""

    solver: Any  # casadi.Function: x0, p, lbx, ubx, lbg, ubg
    nodes: int  # grid points, one more than intervals


@lru_cache(maxsize=CACHED_PROBLEMS)
def build_toppquad(
    nodes: int,
    airframe: Airframe,
    angular_acceleration: float,
    max_iterations: int,
    max_seconds: float,
    penalty: float = PENALTY,
) -> ToppquadNlp:
    """Build the program, cached by number of grid points, airframe, limit of angular acceleration, rad/s², and λ.

    Path, grid and the other limits are parameters and bounds. This limit is not, because without one its row must be
    absent: an unbounded row takes IPOPT ten times as long.
    """
    import casadi

    x = casadi.MX.sym("x", VARIABLES, nodes)
    path = casadi.MX.sym("path", 8, nodes)  # γ' and γ'', cosine and sine of half the yaw where it is fixed
    step = casadi.MX.sym("step")

    rows = node_rows(airframe, angular_acceleration).map(nodes)(x, path)
    steps = interval_residual().map(nodes - 1)(x[:, :-1], x[:, 1:], casadi.repmat(step, 1, nodes - 1))
    first = casadi.sumsqr(x[2:6, 0])
    h, alpha = x[0, :], x[9:12, :]
    duration = casadi.sum2(2 * step / (casadi.sqrt(h[:-1]) + casadi.sqrt(h[1:])))
    nlp: Any = {
        "x": casadi.vec(x),
        "p": casadi.vertcat(step, casadi.vec(path)),
        "f": duration + penalty * casadi.sumsqr(alpha),
        "g": casadi.vertcat(casadi.vec(rows), casadi.vec(steps), first),
    }
    options: Any = {
        "expand": True,
        "print_time": False,
        "error_on_fail": False,
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "max_iter": max_iterations,
            "max_cpu_time": max_seconds,
            "tol": 1e-6,
            "linear_solver": "mumps",
        },
    }
    return ToppquadNlp(casadi.nlpsol("toppquad", "ipopt", nlp, options), nodes)


def node_rows(airframe: Airframe, angular_acceleration: float) -> Any:
    """Return the rows of one grid point: the dynamics in units of g and of a motor's hover torque, then limits."""
    import casadi

    x, path = casadi.SX.sym("x", VARIABLES), casadi.SX.sym("path", 8)
    h, dh, q, omega, alpha = x[0], x[1], x[2:6], x[6:9], x[9:12]
    u = x[12:16] * airframe.hover_thrust
    first, second = path[0:3], path[3:6]
    plane, axial = airframe.drag

    acceleration = 0.5 * first * dh + second * h
    velocity = first * casadi.sqrt(h)
    thrust_axis = casadi.vertcat(
        2 * (q[0] * q[2] + q[1] * q[3]), 2 * (q[1] * q[2] - q[0] * q[3]), 1 - 2 * (q[0] ** 2 + q[1] ** 2)
    )
    wrench = casadi.DM(airframe.mixing) @ u
    force = acceleration + plane / airframe.mass * velocity + casadi.DM([0, 0, GRAVITY])
    lifted = wrench[0] / airframe.mass - (axial - plane) / airframe.mass * casadi.dot(thrust_axis, velocity)
    inertia = casadi.DM(airframe.inertia)
    turning = 0.5 * omega * dh + alpha * h  # angular acceleration in time
    torque = inertia * turning + casadi.cross(omega, inertia * omega) * h
    rows = casadi.vertcat(
        (force - thrust_axis * lifted) / GRAVITY,
        (torque - wrench[1:4]) / (airframe.arm * airframe.hover_thrust),
        casadi.sumsqr(acceleration),
        h * casadi.sumsqr(omega),
        thrust_axis[2],
        wrench[0] / airframe.mass,
        # Hopf: q = q(b₃) ⊗ q_yaw has z : w = sin : cos of half the yaw
        q[2] * path[6] - q[3] * path[7],
        q[3] - q[2],
        casadi.sumsqr(turning) / angular_acceleration**2 if math.isfinite(angular_acceleration) else casadi.SX(0),
    )
    return casadi.Function("node", [x, path], [rows])


def interval_residual() -> Any:
    """Return the residual of one step: zero where x at its end follows from x at its start."""
    import casadi

    x, after, step = casadi.SX.sym("x", VARIABLES), casadi.SX.sym("after", VARIABLES), casadi.SX.sym("step")
    q, omega = x[2:6], x[6:9]
    vector, scalar = q[0:3], q[3]
    turned = casadi.vertcat(
        vector + 0.5 * step * (scalar * omega + casadi.cross(vector, omega)),
        scalar - 0.5 * step * casadi.dot(vector, omega),
    )
    rows = casadi.vertcat(
        after[0] - x[0] - step * x[1],
        after[2:6] - turned / casadi.sqrt(1 + step**2 / 4 * casadi.sumsqr(omega)),
        after[6:9] - omega - step * x[9:12],
    )
    return casadi.Function("interval", [x, after, step], [rows])
