"""The whole command, as a person types it: from a path file to a landed vehicle, its record and its replay.

This is the one flight of the ordinary tests that goes by the computer's clock, with all processes and sockets. It must
land on a busy computer too, so its safety.yaml is patient with late poses and late setpoints.
"""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from cfplan.cli.fly import why_late
from cfplan.errors import ExitCode
from cfplan.recording.importers.formats import read_log

REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-c", "from cfplan.cli import main; main()")

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def flight(tmp_path_factory, patient_safety_file):
    """One flight of flights/line.yaml, watched by a ground station that never speaks, as JSON."""
    records = tmp_path_factory.mktemp("records")
    words = ["fly", "flights/line.yaml", "--safety", str(patient_safety_file), "--records", str(records), "--json"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        place = f"udp:127.0.0.1:{station.getsockname()[1]}"
        ended = subprocess.run(
            [*COMMAND, *words, "--mavlink", place], cwd=REPOSITORY, capture_output=True, text=True,
            stdin=subprocess.DEVNULL, timeout=240, check=False,
        )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_the_flight_lands_within_its_limits(flight):
    assert flight["plan"]["planner"] in ("learned", "convex")
    assert flight["plan"]["certificate"]["passed"]
    assert flight["outcome"]["reason"] == "landed"
    assert flight["outcome"]["rung"] == "none"
    assert flight["max_deviation"] <= 0.08
    assert all(check["passed"] for check in flight["outcome"]["preflight"])


def test_the_record_holds_the_plan_and_the_flight(flight):
    folder = Path(flight["record"])
    files = {"flight.mcap", "plan.parquet", "summary.json", "telemetry.tlog"}
    assert {file.name for file in folder.iterdir()} == files
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["travel_time_planned"] == pytest.approx(flight["plan"]["duration"])
    assert summary["travel_time_flown"] != summary["travel_time_planned"]


def test_the_flight_has_the_same_figures_wherever_they_stand(flight, cfplan):
    """In what `fly` prints, in summary.json and in the report; each figure once."""
    folder = Path(flight["record"])
    summary = json.loads((folder / "summary.json").read_text())
    (reported,) = cfplan("report", folder, "--json").json["flights"]
    figures = {key: value for key, value in summary.items() if isinstance(value, float)}
    assert {"travel_time_flown", "settling", "max_deviation"} <= set(figures)
    for key, value in figures.items():
        assert flight[key] == reported[key] == value, key
    assert not {"flown", "settled_after", "deviation_max"} & set(summary["outcome"])


def test_the_log_of_the_ground_station_is_whole(flight):
    log = read_log(Path(flight["record"]) / "telemetry.tlog")
    assert {"vehicle 1", "vehicle 1 odometry", "vehicle 1 setpoint"} <= {subject.name for subject in log.subjects}
    assert not log.truncated
    assert log.notes == ()


def test_the_record_replays_and_verifies(flight, tmp_path, cfplan):
    file = tmp_path / "flight.rrd"
    ended = cfplan("replay", flight["record"], "--save", file)
    assert ended.code == 0, ended.err
    verified = subprocess.run(
        [Path(sys.executable).parent / "rerun", "rrd", "verify", file], capture_output=True, timeout=60, check=False
    )
    assert verified.returncode == 0


def test_the_recorded_plan_can_be_checked_and_rehearsed_again(flight, cfplan):
    plan = Path(flight["record"]) / "plan.parquet"
    assert cfplan("check", plan).code == 0
    rehearsed = cfplan("sim", plan, "--json")
    assert rehearsed.code == 0
    assert rehearsed.json["dry_run"]["passed"]
    assert rehearsed.json["link_loss"]["beyond"] < 0.0


def test_a_truncated_record_says_so_and_replays_what_is_there(flight, tmp_path, cfplan):
    whole = (Path(flight["record"]) / "flight.mcap").read_bytes()
    (tmp_path / "flight.mcap").write_bytes(whole[: len(whole) // 2])
    ended = cfplan("replay", tmp_path, "--save", tmp_path / "part.rrd")
    assert ended.code == 0
    assert "truncated" in ended.out
    assert (tmp_path / "part.rrd").stat().st_size > 0


@pytest.mark.parametrize(
    ("code", "late", "said"),
    [(7, 0.12, True), (7, 0.004, False), (7, None, False), (6, 0.12, False), (8, 0.12, False)],
)
def test_a_flight_that_a_safety_rule_ended_on_a_busy_computer_says_so(code, late, said):
    assert ("120 ms late" in why_late(ExitCode(code), {"lateness_max": late})) is said
