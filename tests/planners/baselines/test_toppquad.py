"""TOPPQuad's equations hold against scipy's rotations and finite differences; its answers only count once certified."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.planners.baselines import toppquad_nlp
from cfplan.planners.baselines.convex import lower_bound
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.safety.slowing import slow_until_certified
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import Trajectory

pytestmark = pytest.mark.unit
HARDWARE = LIMIT_SETS["hardware"]
NODES = 40


def task(path: Path, **changes) -> PlanningTask:
    """The paper's: free yaw."""
    known = {"airframe": HARDWARE.airframe, "limits": HARDWARE.limits, "nodes": NODES, "yaw": YawMode.FREE}
    return PlanningTask(path, **known | changes)


@pytest.fixture(scope="module")
def path() -> Path:
    return min_snap([[0, 0, 1], [1.2, 0.6, 1.3], [2.2, -0.3, 1.0]])


@pytest.fixture(scope="module")
def free(path) -> Solution:
    return plan_toppquad(task(path))


@pytest.fixture
def variables() -> np.ndarray:
    """One grid point's 16 variables, of no special values."""
    random = np.random.default_rng(5)
    x = random.normal(size=toppquad_nlp.VARIABLES)
    x[0] = 1.7
    x[2:6] /= np.linalg.norm(x[2:6])
    return x


def test_a_step_turns_the_quaternion_as_scipy_does_and_keeps_its_length(variables):
    step, after = 0.1, np.zeros(toppquad_nlp.VARIABLES)
    residual = np.array(toppquad_nlp.interval_residual()(variables, after, step)).ravel()
    h, q, omega = -residual[0], -residual[1:5], -residual[5:8]
    turn = Rotation.from_quat(np.append(step / 2 * variables[6:9], 1.0))
    expected = (Rotation.from_quat(variables[2:6]) * turn).as_quat()
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-12)
    assert abs(q @ expected) == pytest.approx(1.0, abs=1e-12)
    assert h == pytest.approx(variables[0] + step * variables[1])
    np.testing.assert_allclose(omega, variables[6:9] + step * variables[9:12])


def test_the_coupling_is_newton_and_euler_in_time(variables):
    airframe = replace(HARDWARE.airframe, drag=(0.0, 0.0))
    random = np.random.default_rng(6)
    first, second = random.normal(size=(2, 3))
    h, dh, q, omega, alpha = np.split(variables[:12], [1, 2, 6, 9])
    # Time derivatives by moving along s by what dt covers, without the chain rule.
    dt = 1e-6
    ds = np.sqrt(h) * dt
    velocity = [np.sqrt(h + k * ds * dh) * (first + k * ds * second) for k in (-0.5, 0.5)]
    rate = [np.sqrt(h + k * ds * dh) * (omega + k * ds * alpha) for k in (-0.5, 0.5)]
    acceleration, turning = (velocity[1] - velocity[0]) / dt, (rate[1] - rate[0]) / dt
    inertia, now = np.array(airframe.inertia), np.sqrt(h) * omega
    wrench = airframe.mixing @ (variables[12:16] * airframe.hover_thrust)
    thrust_axis = Rotation.from_quat(q).apply([0, 0, 1])
    force_gap = acceleration + np.array([0, 0, GRAVITY]) - thrust_axis * wrench[0] / airframe.mass
    torque_gap = inertia * turning + np.cross(now, inertia * now) - wrench[1:]

    parameters = np.concatenate([first, second, [1.0, 0.0]])
    rows = np.array(toppquad_nlp.node_rows(airframe, 35.0)(variables, parameters)).ravel()
    np.testing.assert_allclose(rows[:3] * GRAVITY, force_gap, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rows[3:6] * airframe.arm * airframe.hover_thrust, torque_gap, rtol=1e-6, atol=1e-10)
    assert rows[6] == pytest.approx(acceleration @ acceleration, rel=1e-6)
    assert rows[7] == pytest.approx(now @ now, rel=1e-9)
    assert rows[8] == pytest.approx(thrust_axis[2], rel=1e-12)
    assert rows[12] * 35.0**2 == pytest.approx(turning @ turning, rel=1e-6)


def test_yaw_starts_in_the_first_quarter_turn(free):
    assert free.status is Status.SOLVED
    assert free.profile is not None
    assert -1e-3 <= free.profile.yaw[0] <= np.pi / 2 + 1e-3


def test_slowed_it_is_certified_and_no_faster_than_the_bound(free, path):
    slowed = slow_until_certified(Trajectory(path, free.profile, HARDWARE.airframe), HARDWARE.limits)
    assert slowed.certificate.passed
    bound = lower_bound(task(path))
    assert bound < slowed.trajectory.duration < 1.5 * bound


def test_fixed_yaw_stays_where_it_was_told(path):
    solution = plan_toppquad(task(path, yaw=YawMode.FIXED, yaw_angle=0.7))
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.profile.yaw, 0.7, atol=1e-6)
    np.testing.assert_allclose(solution.profile.dyaw, 0.0, atol=1e-6)


def test_it_starts_from_the_state_it_is_given(path):
    start = BoundaryState(h=0.5, dh=0.1, ddh=0.0, yaw=0.4, dyaw=0.0)
    solution = plan_toppquad(task(path, start=start))
    assert solution.status is Status.SOLVED
    assert solution.profile.h[0] == pytest.approx(0.5, rel=0.05)
    assert solution.profile.yaw[0] == pytest.approx(0.4, abs=0.01)


def test_the_problem_is_built_once_for_a_size(free, path):
    before = toppquad_nlp.build_toppquad.cache_info().misses
    again = plan_toppquad(task(path.placed([1.0, 0.0, 0.0])))
    assert toppquad_nlp.build_toppquad.cache_info().misses == before
    np.testing.assert_allclose(again.profile.h, free.profile.h, rtol=1e-4)


def test_what_cannot_be_solved_is_an_answer_with_a_reason(path):
    heavy = replace(HARDWARE.limits, motor_thrust_max=0.9 * HARDWARE.airframe.hover_thrust)
    for limits, nodes in ((heavy, NODES), (HARDWARE.limits, 3)):
        solution = plan_toppquad(task(path, limits=limits, nodes=nodes))
        assert solution.status is not Status.SOLVED
        assert solution.profile is None
        assert solution.reason
