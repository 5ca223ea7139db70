"""The path through waypoints that is flown soonest: certified, never later than min-snap, inside, and in time."""

import math
from dataclasses import replace
from itertools import count, pairwise

import numpy as np
import pytest
import yaml

from cfplan.deadline import Deadline
from cfplan.errors import InfeasibleError, InputError
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.geometry.path_file import load_path_file, path_through
from cfplan.geometry.waypoints import Gate, Within
from cfplan.geometry.yaw import YawMode
from cfplan.planners.baselines.point_mass import point_mass_time
from cfplan.planning.path.choice import chosen_path, fastest_path
from cfplan.planning.plan import plan
from cfplan.preparation.plan_flight import give_way
from cfplan.safety.space import Box, Cylinder, check_space
from studies.waypoint_sets import clearance
from tests.geometry.test_path_file import CORNERS, SQUARE

LAWN_MOWER = [
    [-1.5, -1, 1],
    [1.5, -1, 1],
    [1.5, -0.7, 1],
    [-1.5, -0.7, 1],
    [-1.5, -0.4, 1],
    [1.5, -0.4, 1],
    [1.5, -0.1, 1],
]
RECTANGLE = [[-1.5, 0, 1], [1.5, 0, 1], [1.5, 0.3, 1], [-1.5, 0.3, 1], [-1.5, 0, 1]]
RANDOM = {
    f"random {n}": np.random.default_rng(n).uniform([-2, -3.5, 0.3], [2, 3.5, 1.7], (6, 3)) for n in range(500, 504)
}
SETS = {"lawn mower": (LAWN_MOWER, 7.0), "rectangle": (RECTANGLE, 5.0)} | {
    name: (points, math.inf) for name, points in RANDOM.items()
}  # waypoints, and the time that centripetal times take, s, rounded up
ROOMY = {"low": (-20.0, -20.0, -3.0), "high": (20.0, 20.0, 5.0)}


def flight(path, limits, **options) -> float:
    made = plan(path, limits.airframe, limits, **options)
    assert made.certificate.passed
    return made.trajectory.duration


def both_timings(points):
    return min_snap(points), min_snap(points, times=centripetal_times(points))


def choose(points, limits, *, yaw=YawMode.FIXED, yaw_angle=0.0, regions=None, corridor=None, **options):
    given = replace(path_through(points), yaw=yaw, yaw_angle=yaw_angle, corridor=corridor)
    return fastest_path(given if regions is None else replace(given, regions=regions), limits, **options)


def distances(path, points):
    """Return the least distance between the path and each point, m, and the s of the nearest place."""
    s = np.linspace(0.0, path.end, 20_001)
    away = np.linalg.norm(path(s)[:, None] - np.asarray(points, dtype=float), axis=-1)
    return away.min(axis=0), s[away.argmin(axis=0)]


@pytest.mark.parametrize("name", SETS)
def test_the_flight_is_shorter_than_along_min_snap_and_within_the_room(name, limits):
    points, below = SETS[name]
    chosen = choose(points, limits)
    assert chosen.finished
    check_space(chosen.path, limits.space, waypoints=points)
    assert distances(chosen.path, points)[0].max() < 1e-3
    assert np.abs(chosen.path([0.0, chosen.path.end], 1)).max() == 0.0
    assert flight(chosen.path, limits) == chosen.duration < below
    roomy = replace(limits, space=replace(limits.space, **ROOMY))
    assert chosen.duration < 0.98 * min(flight(path, roomy) for path in both_timings(points))


@pytest.mark.parametrize("name", SETS)
def test_the_flight_is_within_a_tenth_of_a_point_mass(name, limits):
    points, _ = SETS[name]
    assert 1.0 < choose(points, limits).duration / point_mass_time(points, limits.plan) < 1.1


def test_a_straight_line_stays_straight(limits):
    chosen = choose(CORNERS[:2], limits)
    assert chosen.duration <= chosen.min_snap == flight(min_snap(CORNERS[:2]), limits)
    first, last = np.array(CORNERS[:2])
    away = np.cross(chosen.path(np.linspace(0.0, chosen.path.end, 50)) - first, (last - first) / math.dist(last, first))
    assert np.linalg.norm(away, axis=1).max() < 0.02


def test_many_points_on_a_line_hardly_slow_the_vehicle_down(limits):
    along = np.array([0.0, 0.02, 0.3, 0.33, 0.35, 0.8, 1.2, 1.21, 1.9, 2.0])
    points = np.column_stack([along - 1.0, 0.5 * along, np.ones(len(along))])
    assert choose(points, limits).duration < 1.2 * choose(points[[0, -1]], limits).duration


def test_the_same_waypoints_have_the_same_path(limits):
    first, second = (choose(RECTANGLE, limits).path for _ in range(2))
    np.testing.assert_array_equal(first.coefficients, second.coefficients)


@pytest.mark.parametrize("questions", [0, 1, 3, 10, 30])
def test_whenever_the_deadline_comes_a_certified_path_is_the_answer(questions, limits):
    ticks = count()
    deadline = Deadline(questions, lambda: float(next(ticks)))
    chosen = choose(LAWN_MOWER, limits, deadline=deadline)
    assert not chosen.finished
    assert "cut short by the budget" in chosen.describe(1.0)
    assert flight(chosen.path, limits) <= 1.001 * min(chosen.duration, chosen.min_snap)


def test_walls_steer_the_choice(limits):
    """Where walls and margin leave 0.15 m around the waypoints' box, min-snap leaves the room with either timing."""
    points = np.array(LAWN_MOWER)
    reach = 0.15 + limits.space.margin
    low, high = (points.min(axis=0) - reach).tolist(), (points.max(axis=0) + reach).tolist()
    space = replace(limits.space, low=tuple(low), high=tuple(high))
    narrow = replace(limits, space=space)
    for path in both_timings(points):
        with pytest.raises(InfeasibleError):
            check_space(path, space)
    chosen = choose(points, narrow)
    check_space(chosen.path, space)
    assert chosen.min_snap == math.inf
    assert flight(chosen.path, narrow) == chosen.duration < 7.0


@pytest.mark.parametrize("width", [0.3, 0.15])
def test_a_corridor_keeps_the_path_near_the_straight_lines(width, limits):
    points = RANDOM["random 501"]
    chosen = choose(points, limits, corridor=width)
    places = chosen.path(np.linspace(0.0, chosen.path.end, 2000))
    lines = [np.linspace(a, b, 500) for a, b in pairwise(points)]
    away = np.linalg.norm(places[:, None] - np.concatenate(lines), axis=-1).min(axis=1)
    assert 0.5 * width < away.max() < width + 1e-3
    assert flight(chosen.path, limits) == chosen.duration > choose(points, limits).duration


def test_waypoints_may_be_passed_within_a_distance(limits):
    points = RANDOM["random 500"]
    chosen = choose(points, limits, regions=(None, *[Within(0.1)] * 4, None))
    away, _ = distances(chosen.path, points)
    assert 0.05 < away.max() < 0.1 + 1e-3
    assert away[[0, -1]].max() < 1e-9
    assert flight(chosen.path, limits) == chosen.duration < 0.975 * choose(points, limits).duration


@pytest.mark.parametrize("yaw", [0.0, math.pi])
def test_gates_are_passed_through_forwards(yaw, limits):
    """A gate between start and end, once in the direction of the way and once against it."""
    points = [[-1.5, 0, 1], [0, 0.3, 1], [1.5, 0, 1]]
    gate = Gate(yaw, 0.8, 0.6)
    chosen = choose(points, limits, regions=(None, gate, None))
    s = np.linspace(0.0, chosen.path.end, 20_001)
    ahead = (chosen.path(s) - points[1]) @ gate.forwards
    inside = np.abs((chosen.path(s) - points[1])[:, 1:]) <= np.array([0.4, 0.3]) - limits.space.margin + 1e-3
    crossed = (ahead[:-1] <= 0.0) & (ahead[1:] > 0.0) & inside[:-1].all(axis=1)
    assert crossed.any()
    assert flight(chosen.path, limits) == chosen.duration


def test_a_corridor_that_no_path_keeps_is_refused_with_its_corner(limits):
    """At 1 mm from the lines it would have to stop at the corner, which no path of least snap does."""
    points = [[-1.5, 0, 1], [-0.5, 0, 1], [0.5, 0, 1], [0.5, 1.5, 1]]
    beside = r"within 0.001 m of the straight lines.* 0\.\d+ m off between waypoints (2 and 3|3 and 4).*hint: widen"
    with pytest.raises(InfeasibleError, match=beside):
        choose(points, limits, corridor=0.001)


def test_a_gate_that_the_margin_fills_is_refused(limits):
    with pytest.raises(InfeasibleError, match=r"gate at waypoint 2 is 0.4 m wide.*0.2 m.*hint"):
        choose([[-1.5, 0, 1], [0, 0, 1], [1.5, 0, 1]], limits, regions=(None, Gate(0.0, 0.4, 1.0), None))


TABLE = Box((-0.6, -0.5, 0.0), (0.6, 0.5, 0.8), name="table")
POLE = Cylinder(0.0, 0.0, 0.1, 0.0, 2.0, "pole")


@pytest.mark.parametrize("obstacles", [(TABLE,), (POLE,), (TABLE, Cylinder(1.2, 1.0, 0.1, 0.0, 2.0))])
def test_obstacles_are_passed_beside_where_link_loss_must_end_clear_of_them(obstacles, limits):
    """Over the table the path is shorter. It leads there only if safety.yaml merely warns of link loss."""
    furnished = replace(limits, space=replace(limits.space, obstacles=obstacles))
    points = [[-1.2, -2.0, 1.0], [0.9, 2.0, 1.2]]
    path = choose(points, furnished).path
    check_space(path, furnished.space)
    assert clearance(path(np.linspace(0.0, path.end, 5000)), obstacles) > limits.space.margin - 1e-6
    planned = plan(path, furnished.airframe, furnished)
    give_way(planned)  # it raises where link loss ends on an obstacle at any speed
    if TABLE in obstacles:
        unminded = replace(furnished, link_loss=replace(furnished.link_loss, only_warn=True))
        over = choose(points, unminded)
        assert flight(over.path, unminded) < 0.98 * planned.trajectory.duration
        with pytest.raises(InfeasibleError, match="table"):
            give_way(plan(over.path, furnished.airframe, furnished))


def test_a_wall_across_the_room_with_a_gap_is_passed_through_the_gap(limits):
    """The straight way leads through the wall, and no descent from there finds the gap."""
    wall = Box((-2.25, -0.1, 0.0), (1.0, 0.1, 2.0), name="partition")
    furnished = replace(
        limits, space=replace(limits.space, obstacles=(wall,)), link_loss=replace(limits.link_loss, only_warn=True)
    )
    chosen = choose([[-1.5, -2.0, 1.0], [-1.5, 2.0, 1.0]], furnished)
    places = chosen.path(np.linspace(0.0, chosen.path.end, 5000))
    assert clearance(places, (wall,)) > limits.space.margin - 1e-6
    crossing = np.abs(places[:, 1]).argmin()
    assert 1.2 - 1e-6 < places[crossing, 0] < 2.05 + 1e-6


def test_where_obstacles_close_the_room_the_refusal_names_one(limits):
    closed = Box((-2.25, -0.1, 0.0), (2.25, 0.1, 2.0), name="partition")
    furnished = replace(limits, space=replace(limits.space, obstacles=(closed,)))
    path = choose([[-1.5, -2.0, 1.0], [-1.5, 2.0, 1.0]], furnished).path
    with pytest.raises(InfeasibleError, match="partition"):
        plan(path, furnished.airframe, furnished)


@pytest.mark.parametrize("points", [
    [[0, 0, 1], [1, 0, 1], [0, 0, 1]],
    [[0, 0, 0.5], [0, 0, 1.5], [0, 0, 0.5]],
    [[0, 0, 1], [1, 0, 1], [0.5, 0, 1], [1.5, 0, 1]],
    [[0, 0, 1], [0, 0.02, 1], [1.5, 0.02, 1], [1.5, 1, 1]],
    [[0, 0, 1.5], [0.1, 0, 0.4]],
])  # fmt: skip
def test_turning_back_dives_and_near_points_are_ordinary(points, limits):
    chosen = choose(points, limits)
    assert flight(chosen.path, limits) == chosen.duration < 1.25 * point_mass_time(points, limits.plan)
    places = chosen.path(np.linspace(0.0, chosen.path.end, 500))
    assert (places > np.min(points, axis=0) - 0.35).all()
    assert (places < np.max(points, axis=0) + 0.35).all()


def test_other_limits_need_no_model(limits):
    gentle = replace(limits, plan=replace(limits.plan, speed=0.4, acceleration=0.4))
    chosen = choose(RECTANGLE, gentle)
    assert flight(chosen.path, gentle) == chosen.duration < 0.98 * chosen.min_snap


@pytest.mark.parametrize("yaw", YawMode)
def test_yaw_is_the_path_files_own(yaw, limits):
    chosen = choose(SQUARE, limits, yaw=yaw, yaw_angle=0.5)
    assert flight(chosen.path, limits, yaw=yaw, yaw_angle=0.5) == chosen.duration <= chosen.min_snap


@pytest.fixture
def load(tmp_path):
    def run(**content):
        file = tmp_path / "path.yaml"
        file.write_text(yaml.safe_dump(content))
        return load_path_file(file)

    return run


def test_laps_have_the_same_times_and_a_place_is_kept(load, limits):
    given = load(waypoints=RECTANGLE, laps=3, place={"x": 0.2, "y": 0.5, "yaw_deg": 90})
    file, fastest = chosen_path(given, limits)
    spans = np.diff(file.path.breaks).reshape(3, -1)
    np.testing.assert_allclose(spans[1:], spans[:-1], rtol=1e-9)
    assert distances(file.path, given.waypoints)[0].max() < 1e-3
    assert fastest.duration == flight(file.path, limits, yaw_angle=file.yaw_angle) < 0.98 * fastest.min_snap


def test_a_file_brings_regions_and_a_corridor(load, limits):
    given = load(
        waypoints=[
            [-1, 0, 1], {"at": [0, 0.5, 1], "within": 0.2},
            {"gate": [1, 0, 1], "yaw_deg": -90, "width": 0.8, "height": 0.8}, [1, -1, 1],
        ],
        corridor=0.4, place={"yaw_deg": 90},
    )  # fmt: skip
    assert given.regions == (None, Within(0.2), Gate(pytest.approx(0.0), 0.8, 0.8), None)
    assert given.corridor == 0.4
    file, fastest = chosen_path(given, limits)
    assert flight(file.path, limits, yaw_angle=file.yaw_angle) == fastest.duration


@pytest.mark.parametrize("times", ["centripetal", "length"])
def test_min_snap_is_kept(times, load, limits):
    given = load(waypoints=SQUARE, shape="min-snap", times=times)
    assert chosen_path(given, limits) == (given, None)


def test_a_waypoint_outside_is_refused_before_any_search(load, limits):
    given = load(waypoints=[*CORNERS, [9, 9, 1]])
    assert chosen_path(given, limits) == (given, None)


def test_waypoints_that_are_none_are_refused():
    for points in ([[0, 0, 1]], [[0, 0, 1], [0, 0, 1]], [[0, 0, 1], [1, math.nan, 1]], [[0, 0], [1, 1]]):
        with pytest.raises(InputError):
            path_through(points)
