"""The curves of the on-board planner."""

import struct

import numpy as np
import pytest

from cfplan.simulation.virtual_crazyflie.high_level import Goal, HighLevelCommander, PlannerState, septic
from cfplan.simulation.virtual_crazyflie.setpoints import ACCELERATION, BODY_RATE, POSITION, VELOCITY, YAW

STILL = np.zeros(4)


def go_to(planner, place, yaw=0.0, duration=2.0, time=0.0, relative=0, linear=0):
    command = struct.pack("<BBBBfffff", 12, 0, relative, linear, *place, yaw, duration)
    return planner.receive(command, time, blocked=False)


@pytest.fixture
def memory():
    """The memory that clients upload to."""
    return bytearray(4096)


@pytest.fixture
def planner(memory):
    return HighLevelCommander(memory, lambda: Goal(np.array([1.0, 2.0, 0.5, 0.3]), STILL, STILL, STILL))


def test_a_septic_meets_its_ends_and_moves_smoothly():
    start = Goal(*np.random.default_rng(1).normal(size=(3, 4)), STILL)
    end = Goal(*np.random.default_rng(2).normal(size=(3, 4)), STILL)
    curve = septic(1.7, start, end)
    for time, wanted in ((0.0, start), (1.7, end)):
        got = curve.at(time)
        for name in ("position", "velocity", "acceleration", "jerk"):
            assert getattr(got, name) == pytest.approx(getattr(wanted, name), abs=1e-9)
    step = 1e-5
    for time in (0.3, 0.9, 1.5):
        ahead, behind, here = curve.at(time + step), curve.at(time - step), curve.at(time)
        assert here.velocity == pytest.approx((ahead.position - behind.position) / (2 * step), rel=1e-5)
        assert here.jerk == pytest.approx((ahead.acceleration - behind.acceleration) / (2 * step), rel=1e-5)


def test_from_rest_to_rest_the_peak_speed_is_35_16_of_the_mean():
    end = Goal(np.array([1.0, 0, 0, 0]), STILL, STILL, STILL)
    curve = septic(2.0, Goal(STILL, STILL, STILL, STILL), end)
    goals = [curve.at(time) for time in np.linspace(0, 2, 401)]
    assert max(goal.velocity[0] for goal in goals) == pytest.approx(35 / 16 * 1.0 / 2.0, rel=1e-4)
    assert max(goal.acceleration[0] for goal in goals) == pytest.approx(7.513 / 4.0, rel=1e-3)


def test_a_go_to_starts_where_the_vehicle_is_and_stays_at_its_end(planner):
    assert go_to(planner, (2.0, 2.0, 1.0), yaw=0.3)[3] == 0
    first, last = planner.setpoint(0.0), planner.setpoint(99.0)
    assert first.values[POSITION] == pytest.approx([1.0, 2.0, 0.5])
    assert last.values[POSITION] == pytest.approx([2.0, 2.0, 1.0])
    assert not last.values[VELOCITY].any()
    assert planner.finished(99.0)
    assert planner.state is PlannerState.FLYING


def test_a_second_go_to_carries_on_from_the_first_without_a_jump(planner):
    go_to(planner, (3.0, 2.0, 1.0))
    before = planner.setpoint(1.0).values.copy()
    go_to(planner, (1.0, 4.0, 1.0), time=1.0)
    after = planner.setpoint(1.0).values
    for part in (POSITION, VELOCITY, ACCELERATION):
        assert after[part] == pytest.approx(before[part], abs=1e-6)


def test_relative_targets_count_from_where_it_is(planner):
    go_to(planner, (0.5, 0.0, 0.1), yaw=0.1, relative=1)
    end = planner.setpoint(9.0).values
    assert end[POSITION] == pytest.approx([1.5, 2.0, 0.6])
    assert end[YAW] == pytest.approx(0.4)


def test_it_turns_the_short_way():
    planner = HighLevelCommander(bytearray(4096), lambda: Goal(np.array([0, 0, 0, 3.0]), STILL, STILL, STILL))
    go_to(planner, (0.0, 0.0, 1.0), yaw=-3.0)
    turned = planner.setpoint(9.0).values[YAW] - planner.setpoint(0.0).values[YAW]
    assert turned == pytest.approx(2 * np.pi - 6.0, abs=1e-6)


def test_body_rates_are_those_of_the_attitude_that_acceleration_asks_for(planner):
    go_to(planner, (3.0, 1.0, 1.5), yaw=1.2, duration=1.5)
    step = 1e-4

    def attitude(time):
        values = planner.setpoint(time).values
        z = values[ACCELERATION] + np.array([0, 0, 9.81])
        z /= np.linalg.norm(z)
        y = np.cross(z, [np.cos(values[YAW]), np.sin(values[YAW]), 0])
        y /= np.linalg.norm(y)
        return np.column_stack([np.cross(y, z), y, z])

    for time in (0.3, 0.8, 1.2):
        skew = attitude(time).T @ (attitude(time + step) - attitude(time - step)) / (2 * step)
        rate = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        assert planner.setpoint(time).values[BODY_RATE][:2] == pytest.approx(rate[:2], abs=1e-4)


def test_landing_ends_idle(planner):
    planner.receive(struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 2.0), 0.0, blocked=False)
    assert planner.setpoint(1.0).mode.any()
    assert not planner.setpoint(2.01).mode.any()
    assert planner.state is PlannerState.IDLE


def piece(duration, coefficients):
    """One uncompressed piece: x, y, z, yaw with eight coefficients each, then its duration."""
    table = np.zeros((4, 8), dtype="<f4")
    for axis, values in coefficients.items():
        table[axis, : len(values)] = values
    return table.tobytes() + struct.pack("<f", duration)


def start(planner, *, relative=0, backwards=0, scale=1.0):
    command = struct.pack("<BBBBBBf", 13, 0, relative, 0, backwards, 1, scale)
    return planner.receive(command, 0.0, blocked=False)[3]


@pytest.fixture
def uploaded(planner, memory):
    """Two seconds of x(t) = t, then one of x(t) = 2 + t + t²."""
    content = piece(2.0, {0: [0.0, 1.0], 2: [1.0]}) + piece(1.0, {0: [2.0, 1.0, 1.0], 2: [1.0]})
    memory[: len(content)] = content
    assert planner.receive(struct.pack("<BBBBIB", 6, 1, 1, 0, 0, 2), 0.0, blocked=False)[3] == 0
    return planner


@pytest.mark.parametrize(
    ("options", "time", "x", "speed"),
    [
        ({}, 1.5, 1.5, 1.0),
        ({}, 2.5, 2.75, 2.0),
        ({}, 9.0, 4.0, 0.0),
        ({"scale": 2.0}, 3.0, 1.5, 0.5),
        ({"backwards": 1}, 0.5, 2.75, -2.0),
        ({"backwards": 1}, 2.0, 1.0, -1.0),
        ({"relative": 1}, 1.5, 2.5, 1.0),
    ],
)
def test_an_uploaded_curve_is_flown_as_asked(uploaded, options, time, x, speed):
    assert start(uploaded, **options) == 0
    values = uploaded.setpoint(time).values
    assert values[0] == pytest.approx(x, abs=1e-5)
    assert values[3] == pytest.approx(speed, abs=1e-5)


def test_a_curve_that_was_never_defined_is_not_executed(planner):
    assert start(planner) == 8
    assert planner.receive(struct.pack("<BBBBIB", 6, 1, 1, 0, 4000, 2), 0.0, blocked=False)[3] == 8


def test_compressed_pieces_are_flown_once_forwards_at_their_own_pace(planner, memory):
    """From (1, 0, 0.5) m by a straight piece to x = 2 m in 2 s, then at rest in x while y goes up a cubic."""
    content = struct.pack("<4h", 1000, 0, 500, 0)
    content += struct.pack("<BHh", 1, 2000, 2000) + struct.pack("<BH3h", 2 << 2, 1000, 0, 300, 300)
    memory[100 : 100 + len(content)] = content
    memory[100 + len(content) : 103 + len(content)] = bytes(3)
    assert planner.receive(struct.pack("<BBBBIB", 6, 1, 1, 1, 100, 2), 0.0, blocked=False)[3] == 0
    assert start(planner, scale=2.0) == 8
    assert start(planner, backwards=1) == 8
    assert start(planner) == 0
    middle, later, end = (planner.setpoint(time).values for time in (1.0, 2.5, 9.0))
    assert middle[POSITION] == pytest.approx([1.5, 0.0, 0.5], abs=1e-5)
    assert middle[VELOCITY] == pytest.approx([0.5, 0.0, 0.0], abs=1e-5)
    assert later[POSITION] == pytest.approx([2.0, 0.15, 0.5], abs=1e-5)
    assert end[POSITION] == pytest.approx([2.0, 0.3, 0.5], abs=1e-5)
    assert not end[VELOCITY].any()


def test_compressed_pieces_that_do_not_end_are_not_executed(planner, memory):
    memory[:] = b"\x01" * len(memory)
    assert planner.receive(struct.pack("<BBBBIB", 6, 1, 1, 1, 0, 2), 0.0, blocked=False)[3] == 0
    assert start(planner) == 8
