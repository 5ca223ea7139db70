"""Constraints and penalty at one point as CasADi expressions, and their derivatives by spline coefficients.

Every physical quantity at a point follows from h and yaw with their derivatives there. They are in node units (s in
grid steps, h divided by a scale), so that the expressions are the same for every path and every N:

    given yaw   (x, x', x'', x''')                      h = scale · x
    free yaw    (x, x', x'', x''', ψ, ψ', ψ'')
"""

from functools import lru_cache
from typing import Any

import casadi

from cfplan.planners.expert.point_constraints import (
    COMMON_DATA,
    LEAST,
    PLACE,
    POINT_DATA,
    ROWS,
    WEIGHT,
    YAW,
    variables,
)
from cfplan.planners.solver.barrier import TERMS
from cfplan.safety import quantities
from cfplan.vehicle import measures, profile_spline, yaw_spline
from cfplan.vehicle.flatness import Body, flat_state
from cfplan.vehicle.profile import h_within, yaw_within


def point_expressions(free_yaw: bool) -> tuple[list[casadi.SX], casadi.SX, casadi.SX]:
    """Return ([variables, point data, common data, penalty weights], constraint rows, penalty)."""
    z = casadi.SX.sym("z", variables(free_yaw))
    point = casadi.SX.sym("point", POINT_DATA)
    common = casadi.SX.sym("common", COMMON_DATA)
    weights = casadi.SX.sym("weights", 3)

    values: list[Any] = casadi.vertsplit(common)
    mass, jx, jy, jz, arm, thrust_to_torque, drag, axial_drag, about_x, about_y, scale = values[:11]
    limits = values[11:]
    data: list[Any] = casadi.vertsplit(point)
    derivatives: Any = tuple(tuple(data[3 * k : 3 * k + 3]) for k in range(4))
    local: list[Any] = casadi.vertsplit(z)
    x, yaw = [casadi.fmax(local[0], LEAST), *local[1:4]], local[4:] if free_yaw else data[YAW:]
    h: Any = tuple(scale * value for value in x)
    body = Body(mass, (jx, jy, jz), arm, thrust_to_torque, (drag, axial_drag), (about_x, about_y))
    measured = measures.measures(flat_state(body, derivatives, h, tuple(yaw), casadi.cos, casadi.sin))
    rows: list[Any] = quantities.rows_of(measured, limits[: len(measured)], limits[len(measured) :])[:ROWS]

    penalty: Any = weights[0] * measured[measures.ANGULAR_ACCELERATION]
    if free_yaw:
        penalty += weights[1] * h[0] * yaw[1] ** 2
    penalty = penalty / casadi.sqrt(h[0]) + weights[2] * (x[3] / x[0]) ** 2
    bounded: Any = casadi.vertcat(*rows)
    return [z, point, common, weights], bounded, data[WEIGHT] * penalty


@lru_cache(maxsize=2)
def point_kernels(free_yaw: bool) -> tuple[casadi.Function, casadi.Function]:
    """Return values and derivatives at one point, as CasADi functions.

    Both take the coefficients, (k,), point data, common data and weights of the penalties, derivatives also Σ and the
    rest of barrier.TERMS, (ROWS,) each. They return the same as Kernels.
    """
    inputs, rows, penalty = point_expressions(free_yaw)
    here, place = inputs[0], inputs[1][PLACE]
    terms = [casadi.SX.sym(name, ROWS) for name in TERMS]
    sigma, multipliers = terms[:2]
    # Differentiated by h and yaw at the point, which is sparser, then by the coefficients through the chain rule.
    jacobian = casadi.jacobian(rows, here)
    gradients = casadi.horzcat(casadi.gradient(penalty, here), casadi.mtimes(jacobian.T, casadi.horzcat(*terms[1:])))
    hessian = casadi.jacobian(casadi.gradient(penalty + casadi.dot(multipliers, rows), here), here)
    hessian += casadi.mtimes(jacobian.T, casadi.repmat(sigma, 1, here.numel()) * jacobian)
    hessian = casadi.tril2symm(casadi.tril(hessian))  # the upper triangle is not computed
    by_here = casadi.Function("by_here", [*inputs, *terms], [rows, penalty, jacobian, gradients, hessian])

    coefficients = casadi.SX.sym("coefficients", here.numel())
    led = _here_by_coefficients(place, free_yaw)
    rows, penalty, jacobian, gradients, hessian = by_here(casadi.mtimes(led, coefficients), *inputs[1:], *terms)
    inputs[0] = coefficients
    jacobian, gradients = casadi.mtimes(jacobian, led), casadi.mtimes(led.T, gradients)
    hessian = casadi.mtimes(led.T, casadi.mtimes(hessian, led))
    size = range(here.numel())
    lower = casadi.vertcat(*(hessian[i, j] for j in size for i in size if i >= j))

    def function(title: str, arguments: list[casadi.SX], results: list[casadi.SX]) -> casadi.Function:
        dense = [casadi.densify(result) for result in results]
        return casadi.Function(title, arguments, casadi.cse(dense))

    return (
        function("values", inputs, [rows, penalty]),
        function("derivatives", [*inputs, *terms], [casadi.vec(jacobian), casadi.vec(gradients), lower]),
    )


def _here_by_coefficients(place: casadi.SX, free_yaw: bool) -> casadi.SX:
    """Return the matrix from the coefficients to h, and yaw, with derivatives at a place in the interval."""
    z = casadi.SX.sym("z", variables(free_yaw))
    h, at_node = h_within(place, *casadi.vertsplit(z)[:4]), casadi.DM(profile_spline.AT_NODE)
    if not free_yaw:
        return casadi.mtimes(casadi.jacobian(casadi.vertcat(*h), z), at_node)
    here = casadi.vertcat(*h, *yaw_within(place, *casadi.vertsplit(z)[4:]))
    return casadi.mtimes(casadi.jacobian(here, z), casadi.diagcat(at_node, casadi.DM(yaw_spline.AT_NODE)))
