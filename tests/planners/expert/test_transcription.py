"""The problems behind the expert: derivatives, backends, solvers, and what lies between the points."""

import casadi
import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.planners.expert import expert as reduced
from cfplan.planners.expert import kernel, point_constraints
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.expert.intersample import Excess
from cfplan.planners.expert.kernel import Backend
from cfplan.planners.expert.point_constraints import Penalties
from cfplan.planners.expert.problem import Ends, pose, profile_of, table_of, tightened, variables_of
from cfplan.planners.expert.program import Program, Shape, layout_of, program
from cfplan.planners.expert.solvers import Attempt, interior_point, ipopt
from cfplan.planners.expert.transcription import SplineProblem
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.trajectory import Trajectory
from cfplan.vehicle.yaw_spline import YawSpline

HARDWARE = LIMIT_SETS["hardware"]
PATH = min_snap(np.array([[0.5, 0.5, 1.0], [3.5, 1.0, 1.5], [3.0, 4.0, 0.8]]))


def posed(shape: Shape):
    track = YawSpline.fixed(PATH, shape.nodes, 0.2, None, None)
    return pose(
        layout_of(shape), PATH, HARDWARE.airframe, HARDWARE.limits, track, 0.2, Ends(None, None), Penalties()
    ), track


@pytest.mark.parametrize("free_yaw", [False, True])
def test_derivatives_put_together_from_blocks_are_those_of_the_whole(free_yaw):
    shape = Shape(8, free_yaw, turning_limited=True)
    pieced = Program(shape)
    problem, _ = posed(shape)
    rng = np.random.default_rng(3)
    x = variables_of(problem.table, problem.layout)
    x += 0.01 * rng.normal(size=len(x))
    multipliers = rng.normal(size=pieced.layout.constraints)

    # The same functions without our derivatives, so that CasADi differentiates the whole.
    symbol = casadi.MX.sym("x", len(x))
    f, g = pieced.nlp(symbol, problem.p)
    lagrangian = 0.7 * f + casadi.dot(multipliers, g)
    whole = casadi.Function(
        "whole", [symbol],
        [casadi.gradient(f, symbol), casadi.jacobian(g, symbol), *casadi.hessian(lagrangian, symbol)],
    )  # fmt: skip
    gradient_f, jacobian, hessian, gradient_l = (np.array(value) for value in whole(x))

    ours_l = pieced.multipliers(x, problem.p, 0.7, multipliers)[2]
    np.testing.assert_allclose(np.array(pieced.gradient(x, problem.p)[1]), gradient_f, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(np.array(pieced.jacobian(x, problem.p)[1]), jacobian, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.array(ours_l), gradient_l, rtol=1e-9, atol=1e-7)
    ours_h = np.array(pieced.upper_hessian(x, problem.p, 0.7, multipliers))
    np.testing.assert_allclose(ours_h, np.triu(hessian), rtol=1e-9, atol=1e-6)


def near_the_guess(problem, size: float, seed: int = 5):
    splines = SplineProblem(problem)
    v = splines.v_of(problem.table)
    return splines, v * (1 + size * np.random.default_rng(seed).uniform(-1, 1, len(v)))


@pytest.mark.parametrize("free_yaw", [False, True])
def test_both_formulations_are_the_same_problem(free_yaw):
    shape = Shape(12, free_yaw, turning_limited=True)
    problem, _ = posed(shape)
    splines, v = near_the_guess(problem, 0.02)
    cost = splines.values(v)
    f, constraints = Program(shape).nlp(variables_of(splines.table_of(v), problem.layout), problem.p)
    constraints = np.array(constraints).ravel()
    assert cost == pytest.approx(float(f), rel=1e-10)
    np.testing.assert_allclose(splines.at_points(), constraints[problem.layout.point_rows], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(constraints[problem.layout.dynamics_rows], 0.0, atol=1e-12)


def test_splines_and_a_solvers_variables_are_the_same_thing():
    problem, _ = posed(Shape(12, True))
    table = problem.table + 0.01 * np.random.default_rng(1).normal(size=problem.table.shape)
    table[-1, 1] = 0.0  # nobody's
    np.testing.assert_allclose(table_of(variables_of(table, problem.layout), problem.layout), table, atol=1e-12)


@pytest.mark.parametrize("free_yaw", [False, True])
def test_derivatives_by_the_splines_are_those_of_differences(free_yaw):
    problem, _ = posed(Shape(9, free_yaw, turning_limited=True))
    splines, v = near_the_guess(problem, 0.02)
    rng = np.random.default_rng(7)
    direction = rng.normal(size=len(v))
    splines.pulls[:] = pulls = rng.normal(size=splines.pulls.shape)
    splines.pulls[0] = pulls[0] = rng.uniform(size=len(splines.g))  # stiffness is never negative

    def around(at):
        cost = splines.values(at)
        splines.expand()
        gradients = splines.gradients.copy()
        return cost, splines.g.copy(), gradients @ direction, splines.along(direction).copy(), gradients[:2].sum(axis=0)

    size = 1e-5
    (before, g_before, _, _, lagrangian_before), (after, g_after, _, _, lagrangian_after) = (
        around(v + k * size * direction) for k in (-1, 1)
    )
    _, _, along_gradients, of_g, _ = around(v)
    bounded = splines.bounds[4] == 1
    assert along_gradients[0] == pytest.approx((after - before) / (2 * size), rel=1e-5)
    np.testing.assert_allclose(of_g[bounded], (g_after - g_before)[bounded] / (2 * size), rtol=1e-4, atol=1e-5)
    assert along_gradients[1:] == pytest.approx(pulls[1:] @ of_g, rel=1e-10)

    curvature = (lagrangian_after - lagrangian_before) / (2 * size)
    size, width = splines.matrix.shape
    whole = np.zeros((size, size))
    for d in range(width):
        whole[np.arange(d, size), np.arange(size - d)] = splines.matrix[d:, d]
    whole += np.tril(whole, -1).T
    splines.pulls[1] = pulls[0] * of_g
    splines.expand()
    product = whole @ direction - splines.gradients[1]  # expand() adds J'ΣJ
    np.testing.assert_allclose(product, curvature, rtol=1e-3, atol=1e-4 * np.abs(curvature).max())


def test_rows_of_the_program_are_what_the_flatness_map_gives():
    shape = Shape(30, False)
    problem, track = posed(shape)
    attempt = interior_point(problem, None)
    profile = profile_of(attempt.table, problem.unit, track, PATH.end)
    trajectory = Trajectory(PATH, profile, HARDWARE.airframe)
    point, row = np.divmod(problem.layout.selected, point_constraints.ROWS)
    values = attempt.at_points
    s = (problem.layout.interval + problem.layout.place) * problem.step
    state = trajectory.at(trajectory.time_at(s[point]))
    limits = HARDWARE.limits
    for which, expected in (
        (point_constraints.ACCELERATION, (np.linalg.norm(state.acceleration, axis=1) / limits.acceleration) ** 2),
        (point_constraints.ANGULAR_VELOCITY, (np.linalg.norm(state.body_rate, axis=1) / limits.angular_velocity) ** 2),
        (point_constraints.SPECIFIC_THRUST, state.specific_thrust / limits.specific_thrust_min),
    ):
        np.testing.assert_allclose(values[row == which], expected[row == which], atol=1e-6)


def test_compiled_code_and_virtual_machine_agree():
    profiles = [
        plan_expert(PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=30), backend=backend).profile
        for backend in Backend
    ]
    np.testing.assert_allclose(profiles[0].h, profiles[1].h, rtol=1e-5)


@pytest.mark.parametrize("turned", [-40.0, -3.2, 0.0, 0.8, 1.6, 3.1, 4.7, 900.0])
@pytest.mark.parametrize("free_yaw", [False, True])
def test_compiled_code_and_virtual_machine_agree_at_each_point_whichever_way_it_looks(free_yaw, turned):
    problem, _ = posed(Shape(24, free_yaw, turning_limited=True))
    points = len(problem.layout.interval)
    problem.p[: points * point_constraints.POINT_DATA].reshape(points, -1)[:, 14] += turned
    problem.table[:, 1:] += turned
    results = []
    for backend in Backend:
        splines = SplineProblem(problem, backend)
        cost = splines.values(splines.v_of(problem.table))
        splines.pulls[:] = np.random.default_rng(1).uniform(0.0, 1.0, splines.pulls.shape)
        splines.expand()
        along = splines.along(np.random.default_rng(2).normal(size=splines.gradients.shape[1]))
        results.append([np.array(cost), splines.g.copy(), splines.gradients, splines.matrix, along.copy()])
    for one, other in zip(*results, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * abs(other).max())


def test_the_virtual_machine_plans_the_same_flight():
    task = PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=31)
    compiled, interpreted = (plan_expert(task, backend=each) for each in Backend)
    assert compiled.status is interpreted.status is Status.SOLVED
    assert (compiled.stats["backend"], interpreted.stats["backend"]) == ("compiled", "virtual machine")
    np.testing.assert_allclose(compiled.profile.h, interpreted.profile.h, rtol=1e-6)


@pytest.fixture
def other_cache(monkeypatch, tmp_path):
    """Compiles kernels anew, for a cache folder of the test's choice."""
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path))
    kernel.machine_code.cache_clear()
    yield tmp_path
    kernel.machine_code.cache_clear()


def test_kernels_compile_where_the_cache_folder_cannot_be_written(monkeypatch, other_cache):
    (other_cache / "file").write_text("")
    monkeypatch.setenv("CFPLAN_CACHE", str(other_cache / "file" / "below"))
    assert set(kernel.machine_code()) == {"given_values", "given_derivatives", "free_values", "free_derivatives"}


def test_kernels_are_compiled_once_and_left_alone(other_cache):
    kernel.machine_code()
    (made,) = other_cache.glob("kernels-*")
    before = made.stat().st_mtime_ns
    kernel.machine_code.cache_clear()
    kernel.machine_code()
    assert made.stat().st_mtime_ns == before
    assert {entry.name for entry in other_cache.iterdir()} == {made.name, "locks"}  # nothing half-made beside it


def test_an_instruction_that_cannot_be_written_out_is_named(monkeypatch):
    x = casadi.SX.sym("x")
    unknown = casadi.Function("unknown", [x], [casadi.atan(x)])
    monkeypatch.setattr(kernel, "point_kernels", lambda free_yaw: (unknown, unknown))
    with pytest.raises(NotImplementedError, match="unknown: instruction"):
        kernel.source()


def test_ipopt_is_told_the_whole_gradient_and_finds_the_same_flight_each_time():
    problem, _ = posed(Shape(40, False, turning_limited=True))
    assert program(problem.layout.shape).gradient.nnz_out(1) == problem.layout.variables
    tables = []
    for size in np.geomspace(3, 3e5, 5):
        junk = [np.full(int(size), np.nan) for _ in range(50)]  # memory that holds no numbers when it is given back
        del junk
        tables.append(ipopt(problem, None).table)
    for table in tables[1:]:
        np.testing.assert_array_equal(table, tables[0])


def test_ipopt_takes_over_where_the_first_solver_fails(monkeypatch):
    def gives_up(problem, backend, searches=()):
        return Attempt("interior point", problem.table, problem.lbg, False, 3, "gave up")

    monkeypatch.setattr(reduced, "interior_point", gives_up)
    solution = plan_expert(PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=40))
    assert solution.status is Status.SOLVED
    assert solution.stats["solver"] == "ipopt"
    assert "gave up" in solution.reason


def test_both_solvers_find_the_same_flight():
    shape = Shape(40, False, turning_limited=True)
    problem, track = posed(shape)
    times = []
    for attempt in (interior_point(problem, None), ipopt(problem, None)):
        assert attempt.solved, attempt.words
        profile = profile_of(attempt.table, problem.unit, track, PATH.end)
        times.append(Trajectory(PATH, profile, HARDWARE.airframe).duration)
    assert times[0] == pytest.approx(times[1], rel=1e-3)


def test_an_answer_that_is_not_a_flight_is_not_believed(monkeypatch):
    def claims(problem, backend, searches=()):
        return Attempt("liar", np.full_like(problem.table, np.nan), problem.lbg, True, 1, "solved")

    monkeypatch.setattr(reduced, "interior_point", claims)
    monkeypatch.setattr(reduced, "ipopt", claims)
    solution = plan_expert(PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=40))
    assert solution.status is Status.NOT_CONVERGED
    assert solution.profile is None
    assert "not finite" in solution.reason


def test_limits_are_lowered_only_around_what_exceeds_them():
    shape = Shape(30, False)
    problem, _ = posed(shape)
    upper = np.full((30, 10), -1.0)
    upper[12, 0] = 0.02
    lowered = tightened(problem, Excess(upper, np.full((30, 10), -1.0)), problem.ubg[problem.layout.point_rows])
    layout = problem.layout
    changed = np.flatnonzero(lowered.ubg != problem.ubg)
    intervals = layout.interval[layout.selected // 9][np.isin(layout.point_rows, changed)]
    assert set(intervals) == {11, 12, 13}
    assert (lowered.lbg == problem.lbg).all()
    assert (lowered.ubx == problem.ubx).all()


def test_many_more_nodes_need_no_other_library():
    before = kernel.machine_code()
    solution = plan_expert(PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=400))
    assert solution.status is Status.SOLVED
    assert certify(Trajectory(PATH, solution.profile, HARDWARE.airframe), HARDWARE.limits).passed
    assert kernel.machine_code() == before
