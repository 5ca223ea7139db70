"""path.yaml: what it can ask for, what is refused, and the flights that come with cfplan."""

import math
import pathlib

import numpy as np
import pytest
import yaml

from cfplan.errors import InputError
from cfplan.geometry.min_snap import centripetal_times, min_snap, smooth_through
from cfplan.geometry.path_file import PathFile, PathShape, load_path_file
from cfplan.geometry.waypoints import Gate, Within
from cfplan.geometry.yaw import YawMode

FLIGHTS = sorted((pathlib.Path(__file__).parents[2] / "flights").glob("*.yaml"))
CORNERS = [[0, 0, 1], [1, 0, 1], [1, 1, 1.2], [0, 1, 1]]
SQUARE = [*CORNERS, [0, 0, 1]]


@pytest.fixture
def load(tmp_path):
    def run(content: str | dict, **files: str) -> PathFile:
        for name, text in files.items():
            (tmp_path / f"{name}.csv").write_text(text)
        file = tmp_path / "path.yaml"
        file.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
        return load_path_file(file)

    return run


def test_waypoints_alone_are_enough(load, tmp_path):
    flight = load({"waypoints": CORNERS})
    assert flight.name == "path"
    assert (flight.yaw, flight.yaw_angle, flight.speed, flight.laps) == (YawMode.FIXED, 0.0, 1.0, 1)
    assert flight.source == tmp_path / "path.yaml"
    np.testing.assert_array_equal(flight.waypoints, CORNERS)
    assert flight.shape is PathShape.FASTEST
    np.testing.assert_allclose(flight.path(flight.path.breaks), CORNERS, atol=1e-12)


@pytest.mark.parametrize(
    ("yaw", "mode", "angle"),
    [
        ("tangent", YawMode.TANGENT, 0.0),
        ("free", YawMode.FREE, 0.0),
        ("fixed", YawMode.FIXED, 0.0),
        ({"mode": "fixed", "angle_deg": -45}, YawMode.FIXED, -math.pi / 4),
        ({"mode": "tangent"}, YawMode.TANGENT, 0.0),
    ],
)
def test_yaw_in_its_long_and_short_form(load, yaw, mode, angle):
    flight = load({"waypoints": CORNERS, "yaw": yaw})
    assert flight.yaw is mode
    assert flight.yaw_angle == pytest.approx(angle)


def test_laps_flow_through_the_start_without_a_stop(load):
    flight = load({"waypoints": SQUARE, "laps": 3})
    assert len(flight.waypoints) == 13
    passes = flight.path.breaks[[4, 8]]
    np.testing.assert_allclose(flight.path(passes), [CORNERS[0]] * 2, atol=1e-9)
    assert np.linalg.norm(flight.path(passes, 1), axis=1).min() > 0.5


def test_place_turns_the_path_about_the_origin_then_moves_it(load):
    here = load({"waypoints": CORNERS})
    there = load({"waypoints": CORNERS, "place": {"x": 2, "z": 0.5, "yaw_deg": 90}})
    x, y, z = here.path(1.5)
    np.testing.assert_allclose(there.path(1.5), [2 - y, x, z + 0.5], atol=1e-12)
    np.testing.assert_allclose(there.waypoints[1], [2, 1, 1.5], atol=1e-12)
    assert there.yaw_angle == pytest.approx(math.pi / 2)


def test_a_fixed_yaw_turns_with_the_place_and_stays_within_half_a_turn(load):
    flight = load({"waypoints": CORNERS, "yaw": {"mode": "fixed", "angle_deg": 170}, "place": {"yaw_deg": 20}})
    assert flight.yaw_angle == pytest.approx(math.radians(-170))


def test_a_path_of_least_snap_has_centripetal_times_or_those_of_the_lengths(load):
    times = centripetal_times(CORNERS)
    for given, expected in (({}, times), ({"times": "centripetal"}, times), ({"times": "length"}, None)):
        flight = load({"waypoints": CORNERS, "shape": "min-snap", **given})
        assert flight.shape is PathShape.MIN_SNAP
        path = min_snap(CORNERS, times=expected)
        share = np.linspace(0.0, 1.0, 7)
        np.testing.assert_allclose(flight.path(share * flight.path.end), path(share * path.end), atol=1e-12)


def test_waypoints_are_points_regions_and_gates_that_turn_with_the_place(load):
    gate = {"gate": [1, 1, 1], "yaw_deg": 45, "width": 0.8, "height": 0.6}
    flight = load({
        "waypoints": [[0, 0, 1], {"at": [1, 0, 1], "within": 0.2}, gate, [0, 0, 1]], "laps": 2, "place": {"yaw_deg": 90}
    })  # fmt: skip
    turned = Gate(pytest.approx(math.radians(135.0)), 0.8, 0.6)
    assert flight.regions == (None, Within(0.2), turned, None, Within(0.2), turned, None)
    np.testing.assert_allclose(flight.waypoints[2], [-1, 1, 1], atol=1e-12)


def test_waypoints_may_turn_back(load):
    assert len(load({"waypoints": [[0, 0, 1], [1, 0, 1], [0, 0, 1]]}).waypoints) == 3


@pytest.mark.parametrize("separator", [",", ";", " ", "\t", ", "])
def test_points_come_from_a_file_however_they_are_separated(load, separator):
    text = f"x{separator}y{separator}z\n# a comment\n\n" + "".join(
        separator.join(map(str, point)) + "\n" for point in CORNERS
    )
    flight = load({"points": "knots.csv"}, knots=text)
    np.testing.assert_array_equal(flight.waypoints, CORNERS)
    np.testing.assert_allclose(flight.path(flight.path.breaks), CORNERS, atol=1e-12)


def table(points) -> str:
    return "\n".join(",".join(f"{v:.6f}" for v in point) for point in points)


def circle(count: int) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count)
    return np.column_stack([np.cos(angle), np.sin(angle), 1 + 0 * angle]).round(6)


@pytest.mark.parametrize("count", [7, 8, 49])
def test_the_key_says_whether_rows_are_waypoints_or_samples_and_no_count_does(load, count):
    rows = circle(count)
    waypoints, samples = load("points: rows.csv\n", rows=table(rows)), load("curve: rows.csv\n")
    np.testing.assert_allclose(waypoints.path(waypoints.path.breaks), rows, atol=1e-9)
    assert waypoints.shape is PathShape.FASTEST
    assert samples.shape is None
    np.testing.assert_array_equal(samples.path.coefficients, smooth_through(rows).coefficients)
    assert waypoints.losses == samples.losses == ()


@pytest.mark.parametrize("key", ["points", "curve"])
def test_columns_that_are_named_are_found_and_others_are_reported(load, key):
    rows = circle(8)
    named = "".join(f"0.3,{1000 * x},{y},{z}\n" for x, y, z in rows)
    flight = load(f"{key}: rows.csv\n", rows=f"yaw,x [mm],Y,z [m]\n{named}")
    np.testing.assert_allclose(flight.waypoints, rows, atol=1e-12)
    assert flight.losses == ("columns are not used: yaw",)
    with pytest.raises(InputError, match=r"4 numbers, not 3 .*write `samples:`"):
        load(f"{key}: rows.csv\n", rows=f"t,x,y,z\n{named}")


def test_samples_of_skybrush_are_in_milliseconds(load):
    rows = "".join(f"{250 * i},{0.1 * i},0,1,255,0,0\n" for i in range(20))
    flight = load("samples: cue.csv\n", cue=f'"Time [msec]","x [m]","y [m]","z [m]",Red,Green,Blue\n{rows}')
    assert flight.path.length == pytest.approx(1.9, abs=0.01)
    assert "4.8 s of 20 samples" in flight.losses[0]
    assert flight.losses[-1] == "columns are not used: red, green, blue"
    with pytest.raises(InputError, match=r"the unit 'h' is unknown \(hint: known: s, "):
        load("samples: cue.csv\n", cue=f"t [h],x,y,z,a,b,c\n{rows}")


def test_polynomials_whose_snap_jumps_are_drawn_smoothly_and_those_whose_jerk_jumps_are_refused(load):
    def pieces(power):
        """1 s along x, then 1 s more that leaves aside with a derivative of this order."""
        first, second = np.zeros((2, 4, 8))
        first[0, 1], second[0, :2] = 1.0, 1.0
        second[1, power] = 0.5 / math.factorial(power)
        return "".join("1.0," + ",".join(f"{value:.9f}" for value in piece.ravel()) + "\n" for piece in (first, second))

    flight = load("polynomials: two.csv\n", two=pieces(4))
    assert "snap jumps at 1 of 1 joints: drawn smoothly" in flight.losses[0]
    np.testing.assert_allclose(flight.waypoints, [[0, 0, 0], [1, 0, 0], [2, 0.5 / 24, 0]], atol=1e-8)
    for time in np.linspace(0.0, 1.0, 11):
        near = flight.path(np.linspace(0, flight.path.end, 20_001)) - [1 + time, 0.5 * time**4 / 24, 0]
        assert np.linalg.norm(near, axis=1).min() < 1e-4
    with pytest.raises(InputError, match=r"jerk jumps by 0\.5 "):
        load("polynomials: two.csv\n", two=pieces(3))
    endless = pieces(4).replace("\n1.0,", "\n1e5,")
    with pytest.raises(InputError, match="more than 50000 samples"):
        load("polynomials: two.csv\n", two=endless)


def test_many_waypoints_recall_the_curve(load):
    flight = load("points: rows.csv\nshape: fastest\n", rows=table(circle(50)))
    assert flight.losses == ("50 rows are waypoints here: write `curve: rows.csv` if they are samples of a curve",)
    assert flight.shape is PathShape.FASTEST
    with pytest.raises(InputError, match=r"0.0063 m apart.*hint: write `curve: rows.csv`"):
        load("points: rows.csv\n", rows=table(circle(1000)))


@pytest.mark.parametrize("name", ["circle", "lissajous", "scan", "trefoil"])
def test_a_flight_of_samples_is_the_smooth_curve_through_them(name):
    (file,) = [file for file in FLIGHTS if file.stem == name]
    flight = load_path_file(file)
    rows = np.loadtxt(file.with_suffix(".csv"), delimiter=",", skiprows=1)
    through = np.concatenate([rows[:1], *[np.concatenate([rows[1:-1], rows[:1]])] * flight.laps])
    expected = rows if flight.laps == 1 else through
    np.testing.assert_array_equal(flight.path.coefficients, smooth_through(expected).coefficients)


def test_hundreds_of_samples_keep_their_shape(load):
    flight = load({"curve": "circle.csv", "laps": 2}, circle=table(circle(500)))
    points = flight.path(np.linspace(0, flight.path.end, 3000))
    np.testing.assert_allclose(np.linalg.norm(points[:, :2], axis=1), 1.0, atol=1e-3)
    assert flight.path.length == pytest.approx(4 * np.pi, rel=1e-3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("name: x\n", ":1:1: one of waypoints, points, curve, polynomials, samples is needed"),
        ("points: a.csv\nwaypoints: [[0,0,1],[1,0,1]]\n", ":2:1: only one of waypoints and points may be given"),
        ("waypoints: []\n", ":1:12: a path needs at least two waypoints, not 0"),
        ("waypoints: [[0,0,1]]\n", ":1:12: a path needs at least two waypoints, not 1"),
        ("waypoints: [[0,0,1],[1,1]]\n", ":1:21: waypoint 2 has 2 numbers, not x, y, z"),
        ("waypoints: [[0,0,1],[1,1,1,1]]\n", ":1:21: waypoint 2 has 4 numbers, not x, y, z"),
        (
            "waypoints:\n- [0,0,1]\n- [0,0,1]\n",
            ":3:3: waypoints 1 and 2 are 0.0000 m apart, less than 0.01 m (hint: remove one of them: a path cannot",
        ),
        ("waypoints:\n- [0,0,1]\n- [1,0,1]\n- [1,0.005,1]\n", ":4:3: waypoints 2 and 3 are 0.0050 m apart"),
        ("waypoints:\n- [0,0,1]\n- [1,.nan,1]\n", ":3:6: a finite number is needed, not .nan"),
        ("waypoints:\n- [0,0,1]\n- [1,1e30,1]\n", ":3:3: coordinates must be numbers within"),
        ("curve: back.csv\n", "the path stops between its ends"),
        ("waypoints: [[0,0,1],[1,0,1]]\ntimes: length\n", ":2:1: times are for shape: min-snap only"),
        ("waypoints: [[0,0,1],[1,0,1]]\nshape: min-snap\ncorridor: 1\n", ":3:1: a corridor is for shape: fastest"),
        ("curve: one.csv\ncorridor: 0.2\n", ":2:1: corridor is for waypoints and points only"),
        ("waypoints: [[0,0,1],[1,0,1]]\ncorridor: 0\n", ":2:11: corridor should be greater than 0"),
        ("waypoints:\n- [0,0,1]\n- {at: [1,0,1], within: 0}\n", ":3:25: waypoints item 2.within should be greater"),
        ("waypoints:\n- [0,0,1]\n- {within: 0.2}\n", ":3:3: waypoints item 2: a waypoint is either `at` or"),
        ("waypoints:\n- [0,0,1]\n- {at: [1,0,1], width: 1}\n", ":3:3: waypoints item 2: width is of a gate"),
        ("waypoints:\n- [0,0,1]\n- {gate: [1,0,1], width: 1, height: 1}\n", ":3:3: waypoints item 2: a gate has"),
        (
            "waypoints:\n- [0,0,1]\n- {gate: [1,0], yaw_deg: 0, width: 1, height: 1}\n",
            ":3:3: waypoint 2 has 2 numbers, not x, y, z",
        ),
        ("shape: min-snap\nwaypoints:\n- [0,0,1]\n- {at: [1,0,1], within: 0.1}\n", ":4:3: gates and `within` are"),
        ("waypoints: [[0,0,1],[1,0,1]]\nlaps: 2\n", ":2:7: 2 laps need a closed path, but the last point is 1.000 m"),
        (
            "waypoints: [{at: [0,0,1], within: 0.5}, [1,1,1], [0,2,1], [0,0,1]]\nlaps: 2\n",
            "last waypoint is the first",
        ),
        (
            "waypoints: [[0,0,1], [1,1,1], [0,2,1], {at: [0,0,1], within: 0.1}]\nlaps: 2\n",
            "differs from it",
        ),
        ("waypoints: [[0,0,1],[1,0,1]]\nlaps: 0\n", ":2:7: laps should be greater than or equal to 1, not 0"),
        ("waypoints: [[0,0,1],[1,0,1]]\nspeed: 0\n", ":2:8: speed should be greater than 0, not 0"),
        ("waypoints: [[0,0,1],[1,0,1]]\nspeed: 1.01\n", ":2:8: speed: a share of the speed that the limits allow"),
        ("waypoints: [[0,0,1],[1,0,1]]\nyaw: left\n", ":2:6: yaw should be 'fixed', 'tangent' or 'free'"),
        ("waypoints: [[0,0,1],[1,0,1]]\nyaw: {mode: free, angle_deg: 9}\n", ":2:19: angle_deg is for mode fixed only"),
        ("waypoints: [[0,0,1],[1,0,1]]\nyaws: free\n", ":2:1: unknown key 'yaws' (hint: did you mean 'yaw'?"),
        (
            "waypoints: [[0,0,1],[1,0,1]]\nshape: quick\n",
            ":2:8: shape should be 'fastest' or 'min-snap', not \"quick\" (hint: ",
        ),
        ("shape:\nwaypoints: [[0,0,1],[1,0,1]]\n", ":1:7: shape should be 'fastest' or 'min-snap'"),
        (
            "curve: one.csv\nshape: fastest\n",
            ":2:1: shape is for waypoints and points only: `curve` already defines its shape (hint: leave shape out",
        ),
        ("polynomials: one.csv\nshape: min-snap\n", ":2:1: shape is for waypoints and points only: `polynomials`"),
        ("samples: one.csv\nshape: fastest\n", ":2:1: shape is for waypoints and points only: `samples`"),
        ("points: gone.csv\n", "gone.csv: no such file"),
        ("polynomials: .\n", "a folder, not a file"),
        (
            "points: short.csv\n",
            "short.csv:2: the row has 2 numbers, not 3 (hint: each row is x, y, z; write `samples:`",
        ),
        ("points: one.csv\n", "one.csv: a path needs at least two points, not 1"),
        ("points: twice.csv\n", "twice.csv:4: waypoints 2 and 3 are 0.0000 m apart"),
        ("curve: twice.csv\n", "twice.csv:4: waypoints 2 and 3 are 0.0000 m apart"),
        (
            "curve: few.csv\n",
            "few.csv: a curve needs at least 4 samples, not 3 (hint: add rows x, y, z to the file, or",
        ),
        (
            "points: slip.csv\nshape: min-snap\ntimes: length\n",
            "slip.csv, waypoint 4: from the point before it is 65533 m",
        ),
        (
            "waypoints: [[65534,0,1],[1,0,1],[1,1,1.2],[65534,0,1]]\nshape: min-snap\ntimes: length\n",
            ":1:12, waypoint 4: from the point before it is 65533 m",
        ),
        ("points: words.csv\n", "words.csv: no rows of numbers"),
        ("polynomials: one.csv\n", "one.csv:1: the row has 3 numbers, not 33"),
    ],
)
def test_each_mistake_is_named_with_its_place(load, content, message):
    with pytest.raises(InputError) as caught:
        load(
            content,
            short="0,0,1\n0,1\n",
            one="1,2,3\n",
            twice="0,0,1\n1,0,1\n\n1,0,1\n",
            few="0,0,1\n1,0,1\n1,1,1\n",
            words="x,y,z\n",
            back="0,0,1\n0.5,0,1\n1,0,1\n0.5,0,1\n0,0,1\n",
            slip="65534,0,1\n1,0,1\n1,1,1.2\n65534,0,1\n",
        )
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "row", ["0,0;0,0;1,0", "0,0 0,0 1,0", "0,0\t0,0\t1,0", "1;0,5;1", "1;0,5", "0,5 1", "0 0 1,5", "1,5;2;1"]
)
def test_decimal_commas_in_a_file_are_refused_as_such(load, row):
    with pytest.raises(InputError, match=r"comma.csv:2: decimal commas.*point"):
        load("points: comma.csv\n", comma=f"0;0;1\n{row}\n2;0;1\n")


@pytest.mark.parametrize("row", ["1,0,1", "1, 0, 1", "1 , 0 ,1", "1;0;1", "1; 0; 1", "1 0 1", "1\t0\t1", "1,0,1,"])
def test_one_separator_is_enough(load, row):
    assert load("points: rows.csv\n", rows=f"0,0,1\n{row}\n").path.end > 0.9


def test_there_are_flights_of_every_kind():
    names = {file.stem for file in FLIGHTS}
    assert names >= {"line", "circle", "figure8", "loop3d", "slalom", "random"}
    flights = [load_path_file(file) for file in FLIGHTS]
    assert {flight.yaw for flight in flights} == set(YawMode)
    texts = [file.read_text() for file in FLIGHTS]
    assert all(any(f"\n{key}:" in text for text in texts) for key in ("waypoints", "curve", "polynomials", "laps"))


@pytest.mark.parametrize("file", FLIGHTS, ids=lambda file: file.stem)
def test_a_flight_keeps_its_distance_from_the_walls_of_the_room(file):
    flight = load_path_file(file)
    x, y, z = np.abs(flight.path(np.linspace(0, flight.path.end, 5000)) - [0, 0, 1]).max(axis=0)
    assert (x, y, z) <= (1.8, 3.5, 0.6)


@pytest.mark.parametrize("file", FLIGHTS, ids=lambda file: file.stem)
def test_a_flight_is_smooth_and_at_rest_at_its_ends(file):
    path = load_path_file(file).path
    inner = path.breaks[1:-1]
    for order in range(5):
        largest = np.abs(path(np.linspace(0, path.end, 2000), order)).max()
        np.testing.assert_allclose(path(np.nextafter(inner, 0), order), path(inner, order), atol=1e-6 * largest)
    for order in (1, 2, 3):
        assert not path([0.0, path.end], order).any()
