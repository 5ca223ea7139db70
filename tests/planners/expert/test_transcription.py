"""The problem behind the expert: derivatives, machine code, what is believed, and how limits are lowered."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
from numba import types
from numba.extending import intrinsic

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.random_paths import random_waypoints
from cfplan.machine_code import njit
from cfplan.planners.expert import expert
from cfplan.planners.expert.derivatives import point_kernels
from cfplan.planners.expert.expert import FROM_GUESS, Attempt, plan_expert, solve
from cfplan.planners.expert.initial_guess import guess
from cfplan.planners.expert.intersample import Violation
from cfplan.planners.expert.kernel import Kernels
from cfplan.planners.expert.point_constraints import ROWS
from cfplan.planners.expert.problem import Ends, Segment, Shape, build_problem, layout_of, tightened
from cfplan.planners.expert.transcription import OBJECTIVE_SCALE, SplineProgram
from cfplan.planners.expert.vector_code import generator
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle import measures
from cfplan.vehicle.trajectory import Trajectory
from cfplan.vehicle.yaw_spline import YawSpline

HARDWARE, SIMULATION = LIMIT_SETS["hardware"], LIMIT_SETS["simulation"]
PATH = min_snap(np.array([[0.5, 0.5, 1.0], [3.5, 1.0, 1.5], [3.0, 4.0, 0.8]]))


def segment_of(shape: Shape) -> Segment:
    yaw = YawSpline.fixed(PATH, shape.nodes, 0.2)
    return Segment(PATH, HARDWARE.airframe, HARDWARE.limits, Ends(None), yaw, layout_of(shape))


def problem_of(shape: Shape):
    return build_problem(segment_of(shape), 0.2)


def near_the_guess(problem, size: float, seed: int = 5):
    program = SplineProgram(problem)
    v = program.v_of(problem.coefficients)
    return program, v * (1 + size * np.random.default_rng(seed).uniform(-1, 1, len(v)))


def test_the_cost_is_the_time_of_flight():
    problem = replace(problem_of(Shape(60, False)), penalties=np.zeros(3))
    program, v = near_the_guess(problem, 0.002)
    trajectory = Trajectory(PATH, segment_of(Shape(60, False)).profile(program.coefficients_of(v)), HARDWARE.airframe)
    assert program.evaluate(v).cost / OBJECTIVE_SCALE == pytest.approx(trajectory.duration, rel=1e-6)


def test_tables_of_coefficients_and_variables_are_the_same_thing():
    problem = problem_of(Shape(12, True))
    program, v = near_the_guess(problem, 0.02)
    np.testing.assert_array_equal(program.v_of(program.coefficients_of(v))[:-1], v[:-1])  # yaw has a coefficient less


@pytest.mark.parametrize("free_yaw", [False, True])
def test_derivatives_by_the_splines_are_those_of_differences(free_yaw):
    problem = problem_of(Shape(9, free_yaw, turning_limited=True))
    program, v = near_the_guess(problem, 0.02)
    rng = np.random.default_rng(7)
    direction = rng.normal(size=len(v))
    terms = rng.normal(size=(4, len(program.evaluate(v).constraints)))
    terms[0] = rng.uniform(size=terms.shape[1])  # Σ is never negative

    def around(at):
        values, near = program.evaluate(at), program.linearise(at, terms)
        return values.cost, values.constraints, near.gradients[:2].sum(axis=0)

    size = 1e-5
    (before, g_before, lagrangian_before), (after, g_after, lagrangian_after) = (
        around(v + k * size * direction) for k in (-1, 1)
    )
    near = program.linearise(v, terms)
    along_gradients, of_g = near.gradients @ direction, near.jvp(direction)
    bounded = program.bounds[4] == 1
    assert along_gradients[0] == pytest.approx((after - before) / (2 * size), rel=1e-5)
    np.testing.assert_allclose(of_g[bounded], (g_after - g_before)[bounded] / (2 * size), rtol=1e-4, atol=1e-5)
    assert along_gradients[1:] == pytest.approx(terms[1:] @ of_g, rel=1e-10)

    curvature = (lagrangian_after - lagrangian_before) / (2 * size)
    size, width = near.matrix.shape
    whole = np.zeros((size, size))
    for d in range(width):
        whole[np.arange(d, size), np.arange(size - d)] = near.matrix[d:, d]
    whole += np.tril(whole, -1).T
    terms[1] = terms[0] * of_g
    product = whole @ direction - program.linearise(v, terms).gradients[1]  # the matrix has J'ΣJ in it
    np.testing.assert_allclose(product, curvature, rtol=1e-3, atol=1e-4 * np.abs(curvature).max())


def test_what_a_problem_hands_out_stays_as_it_is():
    program, v = near_the_guess(problem_of(Shape(9, True)), 0.02)
    terms = np.random.default_rng(1).uniform(size=(4, program.bounds.shape[1]))

    def results(at):
        values, near = program.evaluate(at), program.linearise(at, terms)
        return [np.array(values.cost), values.constraints, near.gradients, near.matrix, near.jvp(v)]

    first = results(v)
    kept = [each.copy() for each in first]
    results(1.1 * v)
    for one, other in zip(first, kept, strict=True):
        np.testing.assert_array_equal(one, other)


def test_rows_of_the_program_are_what_the_flatness_map_gives():
    shape = Shape(30, False)
    problem, segment = problem_of(shape), segment_of(shape)
    attempt = solve(problem, problem.coefficients, FROM_GUESS)
    trajectory = Trajectory(PATH, segment.profile(attempt.coefficients), HARDWARE.airframe)
    layout = problem.layout
    state = trajectory.at(trajectory.time_at(layout.s * problem.step))
    limits = HARDWARE.limits
    for which, expected in (
        (measures.ACCELERATION, (np.linalg.norm(state.acceleration, axis=1) / limits.acceleration) ** 2),
        (measures.BODY_RATE, (np.linalg.norm(state.body_rate, axis=1) / limits.angular_velocity) ** 2),
        (measures.SPECIFIC_THRUST, state.specific_thrust / limits.specific_thrust_min),
    ):
        there = layout.bounded[which]
        np.testing.assert_allclose(attempt.rows[which, there], expected[there], atol=1e-6)


@pytest.mark.parametrize("turned", [-40.0, -3.2, 0.0, 0.8, 1.6, 3.1, 4.7, 900.0])
@pytest.mark.parametrize("free_yaw", [False, True])
def test_compiled_code_computes_what_casadi_does_at_each_point_whichever_way_it_looks(free_yaw, turned):
    problem = problem_of(Shape(24, free_yaw, turning_limited=True))
    problem.point_data[14] += turned
    problem.coefficients[:, 1:] += turned
    layout, weights = problem.layout, problem.penalties
    kernels = Kernels(free_yaw, problem.point_data, problem.common, weights, spare=0)
    for k in range(len(kernels.coefficients)):
        kernels.coefficients[k] = problem.coefficients[layout.interval + k % 4, k // 4]
    terms = np.random.default_rng(1).uniform(0.0, 1.0, (4, ROWS * len(layout.interval)))
    found = [*kernels.evaluate(), kernels.differentiate(terms), kernels.work]

    values, derivatives_at = (each.map(len(layout.interval)) for each in point_kernels(free_yaw))
    given = kernels.coefficients, problem.point_data, *(
        np.tile(each[:, None], len(layout.interval)) for each in (problem.common, weights)
    )  # fmt: skip
    rows, penalties = values(*given)
    jacobian, gradients, hessian = derivatives_at(*given, *terms.reshape(4, ROWS, -1))
    expected = [rows.full().ravel(), penalties.full()[0], jacobian.full(), casadi.vertcat(gradients, hessian).full()]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * abs(other).max())


def test_an_instruction_that_cannot_be_compiled_is_named():
    x = casadi.SX.sym("x")
    unknown = casadi.Function("unknown", [x], [casadi.atan(x)])

    @intrinsic
    def evaluate(_context, first, points, inputs, results):
        return types.void(first, points, inputs, results), generator(unknown, (), 1)

    @njit
    def run(inputs, results):
        evaluate(0, 1, inputs, results)

    with pytest.raises(NotImplementedError, match="unknown: instruction"):
        run((np.ones(1),), (np.ones(1),))


def test_an_answer_that_is_not_a_flight_is_not_believed(monkeypatch):
    def claims(problem, coefficients, starts, deadline):
        return Attempt(np.full_like(coefficients, np.nan), problem.upper, None, True, 1, "solved")

    monkeypatch.setattr(expert, "solve", claims)
    solution = plan_expert(PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=40))
    assert solution.status is Status.NOT_CONVERGED
    assert solution.profile is None
    assert "not finite" in solution.reason


def test_limits_are_lowered_only_around_what_exceeds_them():
    problem = problem_of(Shape(30, False))
    upper = np.full((30, 10), -1.0)
    upper[12, 0] = 0.02
    lowered = tightened(problem, Violation(upper, np.full((30, 10), -1.0)), problem.upper)
    changed = (lowered.upper != problem.upper).any(axis=0)
    assert set(problem.layout.interval[changed]) == {11, 12, 13}
    assert (lowered.lower == problem.lower).all()
    assert (lowered.highest == problem.highest).all()


def test_many_more_nodes_need_no_other_library():
    solution = plan_expert(PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=400))
    assert solution.status is Status.SOLVED
    assert certify(Trajectory(PATH, solution.profile, HARDWARE.airframe), HARDWARE.limits).passed


def test_a_guess_from_a_state_has_it_to_the_last_bit_and_does_not_jerk():
    limits, profile = (
        SIMULATION.limits,
        plan_expert(PlanningTask(PATH, SIMULATION.airframe, SIMULATION.limits, nodes=60)).profile,
    )
    first, last = 20, 45
    part, nodes = PATH.part(profile.s[first], profile.s[last]), last - first
    start, unit = profile.boundary(first), limits.speed**2
    cubic = guess(part, SIMULATION.airframe, limits, nodes, unit=unit, start=start, yaw=None)[:, 0] * unit
    segment = Segment(part, SIMULATION.airframe, limits, Ends(start), YawSpline.fixed(part, nodes, 0.0),
                      layout_of(Shape(nodes, False)))  # fmt: skip
    led = segment.profile(cubic[:, None] / unit).boundary(0)
    np.testing.assert_allclose([led.h, led.dh, led.ddh], [start.h, start.dh, start.ddh], rtol=1e-9, atol=1e-9)
    assert np.abs(np.diff(np.log(cubic), 3)).max() < 0.2


@pytest.mark.parametrize("seed", range(12))
def test_parts_from_a_state_of_a_plan_at_its_limits_are_planned_again(seed):
    """The second solver was needed for these; a guess that leaves a boundary state smoothly is not."""
    path = min_snap(random_waypoints(seed, np.array([[-2.0, -4.0, 0.0], [2.5, 4.0, 2.0]]), (3, 6)))
    airframe, limits = SIMULATION.airframe, SIMULATION.limits
    whole = plan_expert(PlanningTask(path, airframe, limits)).profile
    first, last = 10 + seed, 45 + 4 * seed
    part = path.part(whole.s[first], whole.s[last])
    task = PlanningTask(part, airframe, limits, nodes=last - first, start=whole.boundary(first))
    assert plan_expert(task).status is Status.SOLVED
