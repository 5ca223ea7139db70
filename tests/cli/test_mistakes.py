"""Mistakes in files and commands end in one line with place and hint, the designed exit code, and nothing written.

docs/mistakes.md shows the line of each; its computed numbers may round differently.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.texts import same_text

PAGE = (Path(__file__).parents[2] / "docs" / "mistakes.md").read_text()
LINE = "waypoints: [[0, 0, 1], [1, 0, 1]]\n"

BAD_PATHS = {
    "malformed YAML": ("waypoints: [[0, 0, 1], [1, 0, 1]\nyaw: fixed\n", 2),
    "not a mapping": ("- 1\n- 2\n", 2),
    "empty": ("", 2),
    "an unknown key": (LINE + "waypoint: 3\n", 2),
    "one waypoint": ("waypoints: [[0, 0, 1]]\n", 2),
    "coincident waypoints": ("waypoints:\n  - [0, 0, 1]\n  - [1, 0, 1]\n  - [1, 0, 1]\n", 2),
    "nearly coincident": ("waypoints:\n  - [0, 0, 1]\n  - [1, 0, 1]\n  - [1, 1.0e-6, 1]\n", 2),
    "a NaN": ("waypoints:\n  - [0, 0, 1]\n  - [1, .nan, 1]\n", 2),
    "two coordinates": ("waypoints: [[0, 0, 1], [1, 0]]\n", 2),
    "words for numbers": ("waypoints: [[0, 0, one], [1, 0, 1]]\n", 2),
    "a waypoint outside the space": ("waypoints: [[0, 0, 1], [3, 0, 1]]\n", 3),
    "a waypoint within the margin": ("waypoints: [[0, 0, 1], [2.15, 0, 1]]\n", 3),
    "a path that leaves between its waypoints": (
        "waypoints: [[-2, 0, 1], [2.04, 3.7, 1], [2.04, -3.7, 1], [-2, 0, 1]]\nshape: min-snap\n", 3),
    "no such file of points": ("points: nowhere.csv\n", 2),
    "millimetres": ("waypoints: [[0, -1500, 1000], [300, 1500, 1000]]\n", 3),
    "an unknown shape": (LINE + "shape: fast\n", 2),
    "an unknown timing": (LINE + "shape: min-snap\ntimes: equal\n", 2),
    "times of the fastest path": (LINE + "times: length\n", 2),
    "a waypoint that is no list": ("waypoints:\n  - [0, 0, 1]\n  - {within: 0.2}\n", 2),
    "half a gate": ("waypoints:\n  - [0, 0, 1]\n  - {gate: [1, 0, 1], width: 0.8}\n", 2),
    "a gate narrower than the margin": (
        "waypoints:\n  - [0, 0, 1]\n  - {gate: [1, 0, 1], yaw_deg: 0, width: 0.3, height: 1}\n  - [2, 0, 1]\n", 3),
    "a corridor of a curve": ("curve: line.csv\ncorridor: 0.2\n", 2),
    "a shape of a curve": ("curve: line.csv\nshape: fastest\n", 2),
    "a path under the floor": ("waypoints: [[0, 0, 1], [1, 0, -0.1]]\n", 3),
    "a yaw without its mode": (LINE + "yaw: 90\n", 2),
    "a speed that is no share": (LINE + "speed: 2\n", 2),
    "a speed in m/s": (LINE + "speed: 1.5 m/s\n", 2),
    "a negative speed": (LINE + "speed: -0.5\n", 2),
}  # fmt: skip

BAD_SAFETY = {
    "a negative limit": (r"^  speed: 2.0", "  speed: -2.0", 2),
    "a zero limit": (r"^  acceleration: 5.0", "  acceleration: 0", 2),
    "an unknown key": (r"^  tilt_deg: 30", "  tilt: 30", 2),
    "a tilt in radians": (r"^  tilt_deg: 30", "  tilt_deg: 0.52", 2),
    "an unknown vehicle": (r"^vehicle: \S+", "vehicle: crazyflie-9", 2),
    "limits under which it cannot hover": (r"^  motor_reserve: 0.2", "  motor_reserve: 0.45", 2),
    "a battery too small for the path": (r"^  endurance: 240", "  endurance: 9", 3),
}

COMMANDS = {
    "a path file that is not there": ("plan", "no.yaml"),
    "a mistyped command": ("fyl", "path.yaml"),
    "a mistyped option": ("plan", "path.yaml", "--sped", "0.5"),
    "a mistyped planner": ("plan", "path.yaml", "--planner", "exprt"),
    "no path at all": ("plan",),
    "an example that is not there": ("plan", "--example", "figure9"),
    "hardware without motion capture": ("fly", "path.yaml", "--uri", "radio://0/80/2M/E7E7E7E7E7"),
    "an address of no kind": ("fly", "path.yaml", "--uri", "tcp://somewhere"),
    "another body than the virtual one": ("fly", "path.yaml", "--mocap", "vicon://lab/cf2"),
    "a plan that is no Parquet file": ("plan", "path.yaml", "-o", "line.csv"),
    "a folder that is no record": ("replay", "."),
    "a picture that is no PNG": ("replay", ".", "--png", "flight.jpg"),
    "a folder of records, to be checked": ("check", "."),
    "speed in m/s on the command line": ("plan", "path.yaml", "--speed", "2"),
}

BESIDE = re.compile(r"… [^:]+, \d+ s( \(.*\))?|Usage: .*|Try .*|")  # waiting on a slow computer; how to use a command


@pytest.fixture
def folder(path_file, safety_file, tmp_path, monkeypatch):
    """A folder with a path and limits, to work in."""
    path_file(LINE)
    safety_file()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def error_of(ended, code):
    """The error, one line, of a command that ended with this code."""
    assert ended.code == code, ended.err
    (error,) = [line for line in ended.err.splitlines() if not BESIDE.fullmatch(line)]
    assert error.lower().startswith("error: ")
    return error


def check_as_on_page(mistake, folder, error):
    on_page = re.search(rf"^\| {re.escape(mistake)} \| (?:`` (.*) ``|`(.*)`) \|$", PAGE, re.MULTILINE)
    assert on_page, f"the page does not have {mistake!r}"
    assert same_text(re.sub(r"\S*/(?=(?:path|safety)\.yaml)", "", error), on_page[1] or on_page[2]), error
    assert {file.name for file in folder.iterdir()} == {"path.yaml", "safety.yaml"}


@pytest.mark.parametrize("mistake", BAD_PATHS)
def test_a_mistake_in_a_path_file(cfplan, folder, path_file, mistake):
    text, code = BAD_PATHS[mistake]
    path_file(text)
    check_as_on_page(mistake, folder, error_of(cfplan("check", "path.yaml"), code))


@pytest.mark.parametrize("mistake", BAD_SAFETY)
def test_a_mistake_in_safety_yaml(cfplan, folder, safety_file, mistake):
    pattern, replacement, code = BAD_SAFETY[mistake]
    safety_file((pattern, replacement))
    check_as_on_page(f"{mistake}, in safety.yaml", folder, error_of(cfplan("check", "path.yaml"), code))


@pytest.mark.parametrize("mistake", COMMANDS)
def test_a_mistake_on_the_command_line(cfplan, folder, mistake):
    check_as_on_page(mistake, folder, error_of(cfplan(*COMMANDS[mistake]), 2))


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["fly", "path.yaml", "--records", "/proc/records"], ["/proc/records", "--records"]),
        (["plan", "path.yaml", "-o", "no/such/line.parquet"], ["no/such", "make it first"]),
        (["plan", "path.yaml", "-o", "safety.yaml.parquet"], ["safety.yaml.parquet", "--force"]),
    ],
)
def test_what_would_fail_at_the_end_is_refused_before_anything_is_planned(cfplan, folder, words, parts):
    kept = folder / "safety.yaml.parquet"
    kept.write_text("precious")
    ended = cfplan(*words)
    error = error_of(ended, 2)
    assert ended.out == ""
    assert all(part in error for part in parts), error
    assert kept.read_text() == "precious"
    assert {file.name for file in folder.iterdir()} == {"path.yaml", "safety.yaml", kept.name}


def test_a_missing_safety_file_is_named(cfplan, folder):
    (folder / "safety.yaml").unlink()
    error = error_of(cfplan("plan", "path.yaml"), 2)
    assert "safety.yaml" in error
    assert "--safety" in error


def test_an_error_is_a_document_where_json_is_asked_for(cfplan, folder, path_file):
    path_file("waypoints: [[0, 0, 1]]\n")
    ended = cfplan("check", "path.yaml", "--json")
    assert ended.code == ended.json["exit_code"] == 2
    assert ended.json["error"]
    assert ended.json["where"].endswith("path.yaml:1:12")


@pytest.mark.parametrize("words", [("fyl",), ("plan", "--sped", "0.5"), ("plan",), ("plan", "a.yaml", "--nodes", "x")])
def test_a_mistyped_command_is_a_document_too(cfplan, words):
    ended = cfplan(*words, "--json")
    assert ended.code == ended.json["exit_code"] == 2
    assert ended.json["error"] in ended.err
    assert ended.json["hint"]


def test_an_interrupted_command_ends_with_a_document(cfplan, folder, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("cfplan.safety.limits_file.load_limits", interrupt)
    ended = cfplan("check", "path.yaml", "--json")
    assert ended.code == ended.json["exit_code"] == 130


def test_a_file_that_the_system_refuses_is_named(cfplan, folder):
    name = 300 * "a" + ".yaml"  # too long
    ended = cfplan("check", name, "--json")
    assert ended.code == ended.json["exit_code"] == 2
    assert ended.json["where"] == name
    assert ended.json["hint"]


def run_in_shell(line):
    command = [sys.executable, "-c", "from cfplan.cli import main; main()"]
    line = line.replace("cfplan", shlex.join(command))
    return subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("json", ["", "--json"])
@pytest.mark.parametrize(
    "line",
    [
        "cfplan init lab {} > /dev/full",
        "mkdir gone; cd gone; rmdir ../gone; cfplan plan path.yaml --safety ../safety.yaml -o a.parquet {}",
    ],
    ids=["a full disk", "a deleted folder"],
)
def test_what_the_system_refuses_is_one_line(folder, line, json):
    ended = run_in_shell(line.format(json))
    (error,) = ended.stderr.splitlines()
    assert error.startswith("error: ")
    assert "hint: " in error
    assert ended.returncode == 2


def test_a_full_disk_leaves_nothing_that_keeps_init_from_a_second_try(folder):
    ended = run_in_shell("ulimit -f 2; cfplan init lab --room 4x6x2.5")  # 2 blocks a file, less than safety.yaml
    assert ended.returncode == 2
    assert "lab: cannot be written" in ended.stderr
    assert list((folder / "lab").iterdir()) == []


def test_a_terminal_of_few_characters_is_no_error(folder):
    ended = run_in_shell("PYTHONIOENCODING=latin-1 cfplan init lab")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "? write" in ended.stdout
