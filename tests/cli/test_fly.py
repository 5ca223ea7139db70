"""The whole command, as a person types it: from a path file to a landed vehicle, its record and its replay."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-c", "from cfplan.cli import main; main()")

pytestmark = pytest.mark.integration


def run(*words: object) -> subprocess.CompletedProcess:
    """In a process of its own, without a terminal."""
    return subprocess.run(
        [*COMMAND, *map(str, words)], cwd=REPOSITORY, capture_output=True, text=True, stdin=subprocess.DEVNULL,
        timeout=240, check=False,
    )  # fmt: skip


def fly(name: str, records: Path) -> subprocess.CompletedProcess:
    """Fly a file of flights/. Preflight refuses while the machine is busy with something else: then again."""
    for _ in range(4):
        ended = run("fly", f"flights/{name}.yaml", "--records", records, "--json")
        if ended.returncode != 5 or "this computer's lateness" not in ended.stderr:
            break
    return ended


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """One flight of flights/line.yaml, as JSON."""
    records = tmp_path_factory.mktemp("records")
    ended = fly("line", records)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_the_flight_lands_within_its_limits(flight):
    assert flight["plan"]["planner"] in ("learned", "convex")
    assert flight["plan"]["certificate"]["passed"]
    assert flight["outcome"]["reason"] == "landed"
    assert flight["outcome"]["rung"] == "none"
    assert flight["outcome"]["deviation_max"] <= 0.08
    assert all(check["passed"] for check in flight["outcome"]["preflight"])


def test_the_record_holds_the_plan_and_the_flight(flight):
    folder = Path(flight["record"])
    assert {file.name for file in folder.iterdir()} == {"flight.mcap", "plan.parquet", "summary.json"}
    assert json.loads((folder / "summary.json").read_text())["travel_time_planned"] == pytest.approx(
        flight["plan"]["duration"]
    )


def test_the_record_replays_and_verifies(flight, tmp_path):
    file = tmp_path / "flight.rrd"
    ended = run("replay", flight["record"], "--save", file)
    assert ended.returncode == 0, ended.stderr
    verified = subprocess.run(
        [Path(sys.executable).parent / "rerun", "rrd", "verify", file], capture_output=True, timeout=60, check=False
    )
    assert verified.returncode == 0


def test_the_recorded_plan_can_be_checked_and_rehearsed_again(flight):
    plan = Path(flight["record"]) / "plan.parquet"
    assert run("check", plan).returncode == 0
    rehearsed = run("sim", plan, "--json")
    assert rehearsed.returncode == 0
    assert json.loads(rehearsed.stdout)["dry_run"]["passed"]


def test_a_truncated_record_says_so_and_replays_what_is_there(flight, tmp_path):
    whole = (Path(flight["record"]) / "flight.mcap").read_bytes()
    (tmp_path / "flight.mcap").write_bytes(whole[: len(whole) // 2])
    ended = run("replay", tmp_path, "--save", tmp_path / "part.rrd")
    assert ended.returncode == 0
    assert "truncated" in ended.stdout
    assert (tmp_path / "part.rrd").stat().st_size > 0
