"""Whatever is wrong with the input ends in one line with place and hint, the designed exit code, and no traceback."""

import re

import pytest

from cfplan.cli.fly import why_late
from cfplan.errors import ExitCode

LINE = "waypoints: [[0, 0, 1], [1, 0, 1]]\n"

BAD_PATHS = {
    "malformed YAML": ("waypoints: [[0, 0, 1], [1, 0, 1]\nyaw: fixed\n", 2, "path.yaml:2:"),
    "not a mapping": ("- 1\n- 2\n", 2, "path.yaml:1:1"),
    "empty": ("", 2, "path.yaml"),
    "an unknown key": (LINE + "waypoint: 3\n", 2, "path.yaml:2:1"),
    "one waypoint": ("waypoints: [[0, 0, 1]]\n", 2, "path.yaml:1:"),
    "coincident waypoints": ("waypoints:\n  - [0, 0, 1]\n  - [1, 0, 1]\n  - [1, 0, 1]\n", 2, "path.yaml:4:"),
    "nearly coincident": ("waypoints:\n  - [0, 0, 1]\n  - [1, 0, 1]\n  - [1, 1.0e-6, 1]\n", 2, "path.yaml:4:"),
    "a NaN": ("waypoints:\n  - [0, 0, 1]\n  - [1, .nan, 1]\n", 2, "path.yaml:3:"),
    "two coordinates": ("waypoints: [[0, 0, 1], [1, 0]]\n", 2, "path.yaml:1:"),
    "words for numbers": ("waypoints: [[0, 0, one], [1, 0, 1]]\n", 2, "path.yaml:1:"),
    "a waypoint outside the space": ("waypoints: [[0, 0, 1], [3, 0, 1]]\n", 3, "waypoint 2"),
    "a waypoint within the margin": ("waypoints: [[0, 0, 1], [2.15, 0, 1]]\n", 3, "0.100 m from the wall"),
    "a path that leaves between its waypoints": (
        "waypoints: [[-2, 0, 1], [2.04, 3.7, 1], [2.04, -3.7, 1], [-2, 0, 1]]\n", 3, "path.yaml"),
    "no such file of points": ("points: nowhere.csv\n", 2, "nowhere.csv"),
    "millimetres": ("waypoints: [[0, -1500, 1000], [300, 1500, 1000]]\n", 3, "[0, -1.5, 1]"),
    "a path under the floor": ("waypoints: [[0, 0, 1], [1, 0, -0.1]]\n", 3, "0.100 m beyond the floor z = 0 m"),
    "a yaw without its mode": (LINE + "yaw: 90\n", 2, "write `yaw: {mode: fixed, angle_deg: 90}`"),
    "a speed that is no share": (LINE + "speed: 2\n", 2, "a share of the speed that the limits allow"),
    "a speed in m/s": (LINE + "speed: 1.5 m/s\n", 2, "m/s stand in safety.yaml"),
    "a negative speed": (LINE + "speed: -0.5\n", 2, "path.yaml:2:"),
}  # fmt: skip

BAD_SAFETY = {
    "a negative limit": (r"^  speed: 2.0", "  speed: -2.0", 2, "safety.yaml:8:"),
    "a zero limit": (r"^  acceleration: 5.0", "  acceleration: 0", 2, "safety.yaml:9:"),
    "an unknown key": (r"^  tilt_deg: 30", "  tilt: 30", 2, "safety.yaml:12:"),
    "a tilt in radians": (r"^  tilt_deg: 30", "  tilt_deg: 0.52", 2, "0.52 rad is 29.8"),
    "an unknown vehicle": (r"^vehicle: \S+", "vehicle: crazyflie-9", 2, "safety.yaml:5:"),
    "limits under which it cannot hover": (r"^  motor_reserve: 0.2", "  motor_reserve: 0.45", 2, "safety.yaml:13:"),
    "a battery too small for the path": (r"^  endurance: 240", "  endurance: 9", 3, "endurance"),
}


WAITING = re.compile(r"… [^:]+, \d+ s( \(.*\))?")  # what a slow computer says meanwhile


def assert_one_line(ended, code, *parts):
    """An error that a person can act on."""
    assert ended.code == code, ended.err
    (error,) = [line for line in ended.err.splitlines() if not WAITING.fullmatch(line)]
    assert error.startswith("error: ")
    for part in parts:
        assert part in error


@pytest.mark.parametrize("fault", BAD_PATHS)
def test_a_bad_path_file_ends_in_one_line(cfplan, path_file, safety_file, fault):
    text, code, place = BAD_PATHS[fault]
    ended = cfplan("check", path_file(text), "--safety", safety_file())
    assert_one_line(ended, code, place)


@pytest.mark.parametrize("fault", BAD_SAFETY)
def test_a_bad_safety_file_ends_in_one_line(cfplan, path_file, safety_file, fault):
    pattern, replacement, code, place = BAD_SAFETY[fault]
    ended = cfplan("check", path_file(LINE), "--safety", safety_file((pattern, replacement)))
    assert_one_line(ended, code, place)


def test_a_missing_path_file_is_named(cfplan, safety_file, tmp_path):
    assert_one_line(cfplan("plan", tmp_path / "no.yaml", "--safety", safety_file()), 2, "no.yaml", "hint:")


def test_a_missing_safety_file_is_named(cfplan, path_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_one_line(cfplan("plan", path_file(LINE)), 2, "safety.yaml", "--safety")


def test_a_csv_row_of_wrong_length_is_named(cfplan, path_file, safety_file, tmp_path):
    row = ",".join(["1.0"] + ["0"] * 32)
    (tmp_path / "pieces.csv").write_text(f"{row}\n{row},7\n")
    ended = cfplan("check", path_file("polynomials: pieces.csv\n"), "--safety", safety_file())
    assert_one_line(ended, 2, "pieces.csv:2")


def test_an_unknown_planner_is_named_with_those_there_are(cfplan, path_file, safety_file):
    ended = cfplan("plan", path_file(LINE), "--safety", safety_file(), "--planner", "exprt")
    assert_one_line(ended, 2, "exprt", "expert")


@pytest.mark.parametrize(
    "uri", ["radio://0/80/2M/E7E7E7E7E7", "tcp://somewhere", "sim://nonsense", "udp://127.0.0.1:9"]
)
def test_an_unreachable_vehicle_ends_in_one_line(cfplan, path_file, safety_file, tmp_path, uri):
    ended = cfplan("fly", path_file(LINE), "--safety", safety_file(), "--uri", uri, "--records", tmp_path / "records")
    assert ended.code in (2, 8)
    assert ended.err.splitlines()[-1].startswith("error: ")
    assert uri in ended.err.splitlines()[-1]
    assert "Traceback" not in ended.err
    assert not list((tmp_path / "records").glob("*"))


def test_a_record_that_is_none_is_refused(cfplan, tmp_path):
    (tmp_path / "flight.mcap").write_bytes(b"not a record")
    assert_one_line(cfplan("replay", tmp_path, "--save", tmp_path / "x.rrd"), 2, "flight.mcap")
    assert not (tmp_path / "x.rrd").exists()


def test_a_foreign_plan_file_is_refused(cfplan, safety_file, tmp_path):
    (tmp_path / "plan.parquet").write_bytes(b"PAR1 but not really")
    assert_one_line(cfplan("sim", tmp_path / "plan.parquet", "--safety", safety_file()), 2, "plan.parquet")


def test_an_error_is_a_document_where_json_is_asked_for(cfplan, path_file, safety_file):
    ended = cfplan("check", path_file("waypoints: [[0, 0, 1]]\n"), "--safety", safety_file(), "--json")
    assert ended.code == 2
    assert ended.json["exit_code"] == 2
    assert ended.json["error"]
    assert ended.json["where"].endswith("path.yaml:1:12")


def test_an_existing_plan_is_not_overwritten(cfplan, path_file, safety_file, tmp_path):
    kept = tmp_path / "plan.parquet"
    kept.write_text("precious")
    ended = cfplan("plan", path_file(LINE), "--safety", safety_file(), "-o", kept)
    assert_one_line(ended, 2, "plan.parquet", "--force")
    assert kept.read_text() == "precious"


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["fly", "{path}", "--records", "/proc/records"], ["/proc/records", "--records"]),
        (["fly", "{path}", "--mocap", "vicon://lab/cf2"], ["'cf2'", "vicon://lab/cf1"]),
        (["plan", "{path}", "-o", "line.csv"], ["Parquet", "line.parquet"]),
        (["plan", "{path}", "-o", "no/such/line.parquet"], ["no/such", "make it first"]),
        (["fly", "no.yaml"], ["no.yaml", "no such file"]),
    ],
)
def test_what_would_fail_at_the_end_is_refused_before_anything_is_planned(cfplan, path_file, safety_file, words, parts):
    path = str(path_file(LINE))
    ended = cfplan(*(word.format(path=path) for word in words), "--safety", safety_file())
    assert_one_line(ended, 2, *parts)
    assert ended.out == ""


@pytest.mark.parametrize(
    ("code", "late", "said"),
    [(7, 0.12, True), (7, 0.004, False), (7, None, False), (6, 0.12, False), (8, 0.12, False)],
)
def test_a_flight_that_a_safety_rule_ended_on_a_busy_computer_says_so(code, late, said):
    assert ("120 ms late" in why_late(ExitCode(code), {"lateness_max": late})) is said
