"""min_snap against an independent solution of the same problem, and its limit cases."""

from math import factorial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap, smooth_through
from cfplan.geometry.polynomials import end_values, shifted

WAYPOINTS = np.array([[0, 0, 1], [1.2, 0.4, 1.1], [1.5, -0.8, 0.7], [-0.3, -1.0, 1.2], [-1.0, 0.9, 0.9]])


def derivative_row(time: float, order: int) -> np.ndarray:
    """What a polynomial's eight coefficients are multiplied by to give a derivative."""
    return np.array(
        [factorial(k) / factorial(k - order) * time ** (k - order) if k >= order else 0.0 for k in range(8)]
    )


def by_dense_kkt(points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(M, 8, 3): the quadratic programme over all coefficients, with continuity only as constraints up to jerk."""
    count = len(times)
    gauss, weights = np.polynomial.legendre.leggauss(8)
    cost = np.zeros((8 * count, 8 * count))
    for i, time in enumerate(times):
        for node, weight in zip((gauss + 1) / 2 * time, weights / 2 * time, strict=True):
            row = derivative_row(node, 4)
            cost[8 * i : 8 * i + 8, 8 * i : 8 * i + 8] += weight * np.outer(row, row)
    rows, values = [], []

    def demand(terms: list[tuple[int, np.ndarray]], value: np.ndarray) -> None:
        row = np.zeros(8 * count)
        for piece, coefficients in terms:
            row[8 * piece : 8 * piece + 8] += coefficients
        rows.append(row)
        values.append(value)

    for i, time in enumerate(times):
        demand([(i, derivative_row(0.0, 0))], points[i])
        demand([(i, derivative_row(time, 0))], points[i + 1])
    for order in (1, 2, 3):
        demand([(0, derivative_row(0.0, order))], np.zeros(3))
        demand([(count - 1, derivative_row(times[-1], order))], np.zeros(3))
        for i in range(count - 1):
            demand([(i, derivative_row(times[i], order)), (i + 1, -derivative_row(0.0, order))], np.zeros(3))
    a, b = np.array(rows), np.array(values)
    kkt = np.block([[cost, a.T], [a, np.zeros((len(a), len(a)))]])
    solution = np.linalg.solve(kkt, np.concatenate([np.zeros((8 * count, 3)), b]))
    return solution[: 8 * count].reshape(count, 8, 3)


def test_it_is_the_solution_of_the_quadratic_programme():
    path = min_snap(WAYPOINTS)
    times = np.linalg.norm(np.diff(WAYPOINTS, axis=0), axis=1)
    pieces = by_dense_kkt(WAYPOINTS, times)
    for i, time in enumerate(times):
        local = np.linspace(0, time, 11)
        for order in range(5):
            expected = np.array([derivative_row(x, order) @ pieces[i] for x in local])
            s = np.clip(path.breaks[i] + local, None, np.nextafter(path.breaks[i + 1], 0))
            np.testing.assert_allclose(path(s, order), expected, atol=1e-7)


def test_no_other_path_through_the_waypoints_has_less_snap():
    path = min_snap(WAYPOINTS)
    s = np.linspace(0, path.end, 4001)
    snap = path(s, 4)
    energy = np.trapezoid((snap**2).sum(axis=1), s)
    for seed in range(5):
        # A bump that vanishes with three derivatives at every waypoint keeps all constraints.
        weight = np.random.default_rng(seed).normal(size=3)
        bump = np.polynomial.Polynomial.fromroots(np.repeat(path.breaks, 4)).deriv(4)(s)[:, None] * weight
        bump /= np.abs(bump).max()
        for size in (0.01, -0.01):
            assert np.trapezoid(((snap + size * bump) ** 2).sum(axis=1), s) > energy


def test_time_per_segment_is_its_distance():
    path = min_snap(WAYPOINTS)
    np.testing.assert_allclose(np.diff(path.breaks), np.linalg.norm(np.diff(WAYPOINTS, axis=0), axis=1))
    assert min_snap(WAYPOINTS, nominal_speed=2.0).end == pytest.approx(path.end / 2)


def test_it_passes_through_its_waypoints():
    path = min_snap(WAYPOINTS)
    np.testing.assert_allclose(path(path.breaks), WAYPOINTS, atol=1e-12)


def test_it_is_at_rest_at_both_ends_exactly():
    path = min_snap(WAYPOINTS)
    for order in (1, 2, 3):
        assert not path([0.0, path.end], order).any()
    assert np.linalg.norm(path([0.0, path.end], 4), axis=1).min() > 0.1


def test_near_the_end_the_direction_is_good_to_the_last_digits():
    path = min_snap(WAYPOINTS)
    for end, inward in ((0.0, 1), (path.end, -1)):
        limit = path(end, 4) * inward**3
        near = path(end + inward * 1e-6, 1)
        np.testing.assert_allclose(near / np.linalg.norm(near), limit / np.linalg.norm(limit), atol=1e-5)


def test_all_derivatives_to_the_fifth_are_continuous():
    path = min_snap(WAYPOINTS)
    table, spans = path.coefficients.copy(), np.diff(path.breaks)
    table[-1] = shifted(table[-1:], -spans[-1:])[0]  # about the left end, as the others
    left, right = end_values(spans, table, orders=6)
    scale = np.abs(left).max(axis=(0, 2))[:, None]
    np.testing.assert_allclose(left[1:] / scale, right[:-1] / scale, rtol=0.0, atol=1e-8)


def test_two_waypoints_give_the_rest_to_rest_septic():
    path = min_snap([[0, 0, 1], [2, 0, 1]])
    u = np.linspace(0, 1, 50)
    np.testing.assert_allclose(path(2 * u)[:, 0], 2 * u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3), atol=1e-12)


def test_a_thousand_waypoints_are_solved_as_well_as_five():
    points = np.cumsum(np.random.default_rng(0).uniform(-1, 1, (1000, 3)), axis=0)
    path = min_snap(points)
    np.testing.assert_allclose(path(path.breaks), points, atol=1e-9)
    inner = path.breaks[1:-1]
    for order in range(5):
        before = path(np.nextafter(inner, 0), order)
        np.testing.assert_allclose(before, path(inner, order), atol=1e-9 * np.abs(before).max())


def test_segments_of_centimetres_beside_segments_of_metres_do_not_cost_digits():
    points = np.array([[0, 0, 1], [10, 0, 1], [10.02, 0, 1], [10.04, 0.01, 1], [20, 5, 1]])
    path = min_snap(points)
    np.testing.assert_allclose(path(path.breaks), points, atol=1e-10)
    inner = path.breaks[1:-1]
    for order in range(5):
        before, after = path(np.nextafter(inner, 0), order), path(inner, order)
        np.testing.assert_allclose(before, after, atol=1e-6 * np.abs(path(path.breaks, order)).max())


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0, 0, 1]], "at least two waypoints, not 1"),
        (np.zeros((0, 3)), "at least two waypoints, not 0"),
        ([[0, 0], [1, 1]], "must be x, y, z"),
        ([[0, 0, 1], [0, 0, np.nan], [1, 1, 1]], "waypoint 2: coordinates must be numbers"),
        ([[0, 0, 1], [1, 0, 1], [1, 0, 1]], "waypoints 2 and 3 are 0.0000 m apart"),
        ([[0, 0, 1], [0, 0.009, 1]], "waypoints 1 and 2 are 0.0090 m apart"),
        ([[0, 0, 1], [0, 1e9, 1]], "waypoint 2: coordinates must be numbers within"),
    ],
)
def test_waypoints_that_make_no_path_are_named(points, message):
    with pytest.raises(InputError, match=message):
        min_snap(points)


def test_a_nominal_speed_must_be_positive():
    with pytest.raises(InputError, match="positive"):
        min_snap(WAYPOINTS, nominal_speed=0.0)


def test_dense_points_keep_their_pace_up_to_the_ends():
    angle = np.linspace(0, 2 * np.pi, 200)
    path = smooth_through(np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    s = np.linspace(0, path.end, 2000)
    np.testing.assert_allclose(np.linalg.norm(path(s)[:, :2], axis=1), 1.0, atol=1e-4)
    assert np.linalg.norm(path(s, 1), axis=1).max() < 1.01
    for order in (1, 2, 3):
        assert not path([0.0, path.end], order).any()


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-100, 100)] * 3), min_size=2, max_size=12),
)
def test_any_waypoints_give_a_path_through_them_or_an_error(points):
    try:
        path = min_snap(points)
    except InputError:
        return
    reached = path(path.breaks) if len(points) > 2 else path([0.0, path.end])
    np.testing.assert_allclose(reached, points, atol=1e-6)


def test_a_coordinate_that_slipped_by_kilometres_is_named():
    """Found by fuzzing: beside a segment of 65 km the others leave no digits to solve with."""
    angle = np.linspace(0.0, 2 * np.pi, 25)
    circle = 1.4 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    circle[22, 0] = 65535.0
    with pytest.raises(InputError, match=r"waypoint 2[34].*no smooth path joins these"):
        smooth_through(circle)
