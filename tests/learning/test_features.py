"""What networks see: the geometry of the nodes, limits and vehicle without dimension, and nothing else."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.features import (
    COLUMNS,
    INPUTS,
    LOGARITHMS,
    NUMBERS,
    POSITION,
    REFERENCE,
    ROOM,
    ROOMS,
    TURNS,
    coefficient_logs,
    fill_inputs,
    fill_node_features,
    node_features,
    rests,
    scaled_limits,
    start_coefficients,
    start_features,
)
from cfplan.learning.training_set import draw, read_training_set
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.yaw_spline import YawSpline

CHOSEN = LIMIT_SETS["hardware"]
KNOWN = scaled_limits(CHOSEN.airframe, CHOSEN.limits)
PATH = min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9], [1.5, 1.0, 1.4]])
START = (2.0, 0.1, 0.01)


def table_of(path: Path, first: float, step: float, count: int = 20, turns: float = 0.0, known=KNOWN) -> np.ndarray:
    table = np.empty((count, COLUMNS))
    turned = np.full((count, 2), turns)
    fill_node_features(table, path.breaks, path.coefficients / known.length, first, step, known.bounds, turned)
    return table


def inputs(path: Path, first: float, step: float, count: int = 20, yaw: float = 0.3, known=KNOWN) -> np.ndarray:
    out = np.empty((count, INPUTS), np.float32)
    table = table_of(path, first, step, count, known=known)
    fill_inputs(out, table, first == 0.0, False, first > 0, START, yaw, 0.01, True, known.numbers)
    return out


def test_derivatives_are_those_of_the_path_per_step_in_units_of_length():
    step, first = 0.07, 0.3
    table = table_of(PATH, first, step, 30)
    s = first + step * np.arange(30)
    unit = CHOSEN.limits.speed**2 / GRAVITY
    for order in range(4):
        expected = PATH(s, order) * step**order / unit
        np.testing.assert_allclose(table[:, 3 * order : 3 * order + 3], expected, atol=1e-11)


def test_the_last_piece_and_beyond_stay_at_the_end():
    table = table_of(PATH, PATH.end - 0.1, 0.05, 6)
    expected = np.tile(PATH(PATH.end), (4, 1)) / KNOWN.length
    np.testing.assert_allclose(table[2:, POSITION], expected, atol=1e-9)


def scaled(length: float, time: float):
    """The same vehicle, limits and path in a world whose lengths and times are so many times as long; g stays."""
    assert length == pytest.approx(time**2)
    limits, airframe = CHOSEN.limits, CHOSEN.airframe
    larger = replace(
        limits, speed=limits.speed * length / time, angular_velocity=limits.angular_velocity / time,
        angular_acceleration=limits.angular_acceleration / time**2,
    )  # fmt: skip
    vehicle = replace(
        airframe, inertia=tuple(j * time**2 for j in airframe.inertia),
        drag=tuple(d * time / length for d in airframe.drag),
    )  # fmt: skip
    return vehicle, larger, min_snap(length * PATH(PATH.breaks))


@pytest.mark.parametrize("time", [0.3, 2.5])
def test_a_world_of_another_size_looks_the_same(time):
    """Accelerations, thrusts and angles are the same in it, speeds grow with time, rates fall with it."""
    vehicle, limits, path = scaled(time**2, time)
    here, there = (
        inputs(PATH, 0.0, PATH.end / 19),
        inputs(path, 0.0, path.end / 19, known=scaled_limits(vehicle, limits)),
    )
    np.testing.assert_allclose(there, here, atol=2e-4)


def test_numbers_are_those_of_limits_and_vehicle():
    """Against the definitions, by name."""
    numbers = dict(zip(NUMBERS, KNOWN.numbers, strict=True))
    for name in NUMBERS[:LOGARITHMS]:
        numbers[name] = math.exp(numbers[name])
    airframe, limits = CHOSEN.airframe, CHOSEN.limits
    time = limits.speed / GRAVITY
    assert numbers["acceleration"] == pytest.approx(5.0 / GRAVITY)
    assert numbers["angular velocity"] == pytest.approx(8.0 * time)
    assert numbers["angular acceleration"] == pytest.approx(35.0 * time**2)
    assert numbers["thrust upwards"] == pytest.approx(4 * limits.motor_thrust_max / (airframe.mass * GRAVITY) - 1)
    assert numbers["tilt"] == limits.tilt
    # Two motors up and two down by what they spare turn about x
    spare = min(limits.motor_thrust_max - airframe.hover_thrust, airframe.hover_thrust - limits.motor_thrust_min)
    torque = airframe.mixing @ (spare * np.array([-1, -1, 1, 1]))
    assert numbers["roll authority"] == pytest.approx(torque[1] / airframe.inertia[0] * time**2)


def test_without_a_limit_on_turning_numbers_are_finite():
    free = replace(CHOSEN.limits, angular_acceleration=math.inf)
    assert np.isfinite(scaled_limits(CHOSEN.airframe, free).numbers).all()


@pytest.mark.parametrize("first", [0.0, 0.4])
@pytest.mark.parametrize("turn", [0.7, -2.5, math.pi])
def test_place_and_heading_do_not_matter(first, turn):
    moved = PATH.placed([3.0, -7.0, 2.0], turn)
    np.testing.assert_allclose(inputs(moved, first, 0.05, yaw=0.3 + turn), inputs(PATH, first, 0.05), atol=2e-5)


def test_half_a_turn_of_the_vehicle_does_not_matter():
    np.testing.assert_allclose(inputs(PATH, 0.4, 0.05, yaw=0.3 + math.pi), inputs(PATH, 0.4, 0.05), atol=2e-5)
    assert np.abs(inputs(PATH, 0.4, 0.05, yaw=0.3 + math.pi / 2) - inputs(PATH, 0.4, 0.05)).max() > 0.1


def test_up_stays_up():
    """Turned about anything but the vertical, the same curve is another task."""
    table = PATH.coefficients[:, :, [2, 1, 0]]
    assert np.abs(inputs(Path(PATH.breaks, table), 0.4, 0.05) - inputs(PATH, 0.4, 0.05)).max() > 0.01


@pytest.mark.parametrize("first", [0.0, 0.4])
def test_the_unit_of_s_does_not_matter(first):
    """The same nodes on the same curve, run through three times as fast."""
    powers = 3.0 ** np.arange(PATH.coefficients.shape[1])
    faster = Path(PATH.breaks / 3.0, PATH.coefficients * powers[:, None])
    np.testing.assert_allclose(inputs(faster, first / 3.0, 0.05 / 3.0), inputs(PATH, first, 0.05), atol=2e-5)


def test_the_reference_is_within_every_bound_and_near_the_least():
    """Against the limits themselves: at h = reference² Δs², with h' = 0, none is exceeded."""
    step = 0.05
    table = table_of(PATH, 0.0, step, 100)
    h = np.exp(2 * table[:, REFERENCE]) * (step / KNOWN.time) ** 2
    s = step * np.arange(100)
    sizes = [np.linalg.norm(PATH(s, order), axis=1) * h ** (order / 2) for order in (1, 2, 3, 4)]
    up = 4 * (CHOSEN.limits.motor_thrust_max - CHOSEN.airframe.hover_thrust) / CHOSEN.airframe.mass
    limits = (2.0, min(5.0, up), 8.0 * GRAVITY, 35.0 * GRAVITY)
    shares = np.array([size / limit for size, limit in zip(sizes, limits, strict=True)])
    assert shares.max() <= 1.0
    assert (shares ** (1 / np.array([[1], [2], [3], [4]]))).max(axis=0).min() > 0.75


def test_rest_and_flight_straight_up_have_finite_inputs():
    up = min_snap([[0, 0, 0.5], [0, 0, 2.0], [0, 0, 3.0]])
    assert rests(PATH, 0.0)
    assert rests(PATH, PATH.end)
    assert not rests(PATH, 0.5)
    for path in (PATH, up):
        found = inputs(path, 0.0, path.end / 19)
        assert found.shape == (20, INPUTS)
        assert np.isfinite(found).all()
        assert found[:, ROOMS].max() <= ROOM


def test_a_turning_vehicle_is_slowed_by_its_yaw():
    """Where yaw is given, its rate and acceleration bound the reference too."""
    still, turning = table_of(PATH, 0.4, 0.05), table_of(PATH, 0.4, 0.05, turns=2.0)
    assert np.all(turning[:, REFERENCE] < still[:, REFERENCE] - 0.1)
    assert np.all(np.exp(turning[:, REFERENCE]) * 2.0 <= 8.0 * KNOWN.time)
    assert np.all(turning[:, TURNS] == 2.0)


def test_a_start_is_told_by_the_spline_that_it_begins():
    """The first three coefficients make a cubic with the state's h, h' and h'' at the node."""
    state, step = BoundaryState(h=1.3, dh=-0.8, ddh=2.0, yaw=0.0, dyaw=0.0), 0.1
    u = start_coefficients(state, step)
    assert (u[0] + 4 * u[1] + u[2]) / 6 == pytest.approx(state.h)
    assert (u[2] - u[0]) / (2 * step) == pytest.approx(state.dh)
    assert (u[2] - 2 * u[1] + u[0]) / step**2 == pytest.approx(state.ddh)
    logs = coefficient_logs(state.h, state.dh * step, state.ddh * step**2, step)
    np.testing.assert_allclose(np.exp(2 * np.array(logs)) * step**2, u)
    rate, slope, bend = start_features(*logs)
    assert math.exp(rate) == pytest.approx(math.sqrt(u[1]) / step)
    assert math.exp(slope) == pytest.approx(math.sqrt(u[2] / u[0]))
    assert math.exp(bend) == pytest.approx(math.sqrt(u[2] * u[0]) / u[1])


def test_training_sees_what_flight_sees(tiny):
    """Windows at a path's start, from a dataset's rows and from the paths rebuilt as the planner has them."""
    training_set = read_training_set(tiny)
    one_window = {"at_start": 0.9, "at_end": 0.0, "closest": 1e9, "widest": 1e9}  # takes all of a path
    rows = np.arange(len(training_set.rows))
    batch = draw(training_set.labels, rows, 30, np.random.default_rng(0), **one_window)
    for row, path in enumerate(training_set.paths):
        track = YawSpline.along(path, 30, YawMode.FIXED, 0.0)
        table = node_features(path, 30, KNOWN, track)
        found = np.empty((31, INPUTS), np.float32)
        fill_inputs(found, table, True, True, False, START, 0.0, 0.0, False, KNOWN.numbers)
        np.testing.assert_allclose(batch.inputs[row], found, atol=1e-5)
