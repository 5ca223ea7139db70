"""The program behind the expert: derivatives, backends, solvers, and what lies between the points."""

import shutil

import casadi
import numpy as np
import pytest

from cfplan.expert import compiled, reduced, stage
from cfplan.expert.between import Excess
from cfplan.expert.compiled import Backend
from cfplan.expert.limit_sets import LIMIT_SETS
from cfplan.expert.problem import Ends, pose, profile_of, tightened
from cfplan.expert.program import Program, Shape, program
from cfplan.expert.reduced import plan_reduced
from cfplan.expert.solution import Status
from cfplan.expert.solvers import Attempt, fatrop, ipopt
from cfplan.expert.stage import Penalties
from cfplan.expert.yaw_track import fixed_yaw
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.certificate import certify
from cfplan.vehicle.trajectory import Trajectory

HARDWARE = LIMIT_SETS["hardware"]
PATH = min_snap(np.array([[0.5, 0.5, 1.0], [3.5, 1.0, 1.5], [3.0, 4.0, 0.8]]))


def posed(shape: Shape, backend: Backend | None = None):
    track = fixed_yaw(PATH, shape.nodes, 0.2, None, None)
    layout = program(shape, backend).layout
    return pose(layout, PATH, HARDWARE.airframe, HARDWARE.limits, track, 0.2, Ends(None, None), Penalties()), track


@pytest.mark.parametrize("free_yaw", [False, True])
def test_derivatives_put_together_from_blocks_are_those_of_the_whole(free_yaw):
    shape = Shape(8, free_yaw, turning_limited=True)
    pieced = Program(shape, Backend.VIRTUAL_MACHINE)
    problem, _ = posed(shape, Backend.VIRTUAL_MACHINE)
    rng = np.random.default_rng(3)
    x = problem.x0 + 0.01 * rng.normal(size=len(problem.x0))
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

    ours_l, ours_h = pieced.hessian(x, problem.p, 0.7, multipliers)
    np.testing.assert_allclose(np.array(pieced.gradient_only(x, problem.p)), gradient_f, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(np.array(pieced.jacobian(x, problem.p)[1]), jacobian, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.array(ours_l), gradient_l, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(np.array(ours_h), hessian, rtol=1e-9, atol=1e-6)


def test_rows_of_the_program_are_what_the_flatness_map_gives():
    shape = Shape(30, False)
    problem, track = posed(shape)
    pieces = program(shape)
    attempt = fatrop(shape, problem, None)
    profile = profile_of(attempt.x, problem, track, PATH.end)
    trajectory = Trajectory(PATH, profile, HARDWARE.airframe)
    point, row = np.divmod(pieces.layout.selected, stage.ROWS)
    values = attempt.g[pieces.layout.point_rows]
    s = (pieces.layout.interval + pieces.layout.place) * problem.step
    state = trajectory.at(trajectory.time_at(s[point]))
    limits = HARDWARE.limits
    for which, expected in (
        (stage.ACCELERATION, (np.linalg.norm(state.acceleration, axis=1) / limits.acceleration) ** 2),
        (stage.ANGULAR_VELOCITY, (np.linalg.norm(state.body_rate, axis=1) / limits.angular_velocity) ** 2),
        (stage.SPECIFIC_THRUST, state.specific_thrust / limits.specific_thrust_min),
    ):
        np.testing.assert_allclose(values[row == which], expected[row == which], atol=1e-6)


@pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler")
def test_compiled_code_and_virtual_machine_agree():
    assert compiled.backend() is Backend.COMPILED
    profiles = [
        plan_reduced(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=30, backend=backend).profile for backend in Backend
    ]
    np.testing.assert_allclose(profiles[0].h, profiles[1].h, rtol=1e-5)


def test_without_a_compiler_the_virtual_machine_plans(monkeypatch, tmp_path):
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path / "empty"))
    monkeypatch.setattr(shutil, "which", lambda *_: None)
    compiled.library.cache_clear()
    compiled.functions.cache_clear()
    try:
        assert compiled.backend() is Backend.VIRTUAL_MACHINE
        solution = plan_reduced(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=31)
        assert solution.status is Status.SOLVED
        assert solution.stats["backend"] == "virtual machine"
    finally:
        compiled.library.cache_clear()
        compiled.functions.cache_clear()


def test_a_cache_folder_that_cannot_be_written_falls_back(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path / "file" / "below"))
    compiled.library.cache_clear()
    try:
        assert compiled.library() is None
    finally:
        compiled.library.cache_clear()


@pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler")
def test_the_library_is_made_once_and_left_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path))
    compiled.library.cache_clear()
    try:
        made = compiled.library()
        assert made is not None
        before = made.stat().st_mtime_ns
        compiled.library.cache_clear()
        assert compiled.library() == made
        assert made.stat().st_mtime_ns == before
        assert [entry.name for entry in tmp_path.iterdir()] == [made.name]  # nothing half-made beside it
    finally:
        compiled.library.cache_clear()


def test_ipopt_takes_over_where_fatrop_fails(monkeypatch):
    def gives_up(shape, problem, backend, x=None):
        return Attempt("fatrop", problem.x0, problem.lbg, False, 3, "gave up")

    monkeypatch.setattr(reduced, "fatrop", gives_up)
    solution = plan_reduced(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=40)
    assert solution.status is Status.SOLVED
    assert solution.stats["solver"] == "ipopt"
    assert "gave up" in solution.reason


def test_both_solvers_find_the_same_flight():
    shape = Shape(40, False, turning_limited=True)
    problem, track = posed(shape)
    times = []
    for attempt in (fatrop(shape, problem, None), ipopt(shape, problem, None)):
        assert attempt.solved, attempt.words
        times.append(Trajectory(PATH, profile_of(attempt.x, problem, track, PATH.end), HARDWARE.airframe).duration)
    assert times[0] == pytest.approx(times[1], rel=1e-3)


def test_an_answer_that_is_not_a_flight_is_not_believed(monkeypatch):
    def claims(shape, problem, backend, x=None):
        return Attempt("liar", np.full_like(problem.x0, np.nan), problem.lbg, True, 1, "solved")

    monkeypatch.setattr(reduced, "fatrop", claims)
    monkeypatch.setattr(reduced, "ipopt", claims)
    solution = plan_reduced(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=40)
    assert solution.status is Status.NOT_CONVERGED
    assert solution.profile is None
    assert "not finite" in solution.reason


def test_limits_are_lowered_only_around_what_exceeds_them():
    shape = Shape(30, False)
    problem, _ = posed(shape)
    upper = np.full((30, 10), -1.0)
    upper[12, 0] = 0.02
    lowered = tightened(problem, Excess(upper, np.full((30, 10), -1.0)), problem.ubg)
    layout = problem.layout
    changed = np.flatnonzero(lowered.ubg != problem.ubg)
    intervals = layout.interval[layout.selected // 9][np.isin(layout.point_rows, changed)]
    assert set(intervals) == {11, 12, 13}
    assert (lowered.lbg == problem.lbg).all()
    assert (lowered.ubx == problem.ubx).all()


def test_many_more_nodes_need_no_other_functions():
    before = set(compiled.functions())
    solution = plan_reduced(PATH, HARDWARE.airframe, HARDWARE.limits, nodes=400)
    assert solution.status is Status.SOLVED
    assert certify(Trajectory(PATH, solution.profile, HARDWARE.airframe), HARDWARE.limits).passed
    assert set(compiled.functions()) == before
