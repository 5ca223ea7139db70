"""`cfplan fly --on-board` as a person types it: cflib uploads over the virtual radio."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cfplan.recording.reader import read_record

REPOSITORY = Path(__file__).parents[2]

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@pytest.fixture(scope="module")
def flight(tmp_path_factory, patient_safety_file):
    """One flight of flights/line.yaml, as JSON."""
    records = tmp_path_factory.mktemp("records")
    words = ["fly", "flights/line.yaml", "--on-board", "--safety", patient_safety_file, "--records", records, "--json"]
    ended = subprocess.run(
        [sys.executable, "-m", "cfplan", *map(str, words)], cwd=REPOSITORY, capture_output=True, text=True,
        stdin=subprocess.DEVNULL, timeout=240, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_it_lands_near_its_plan(flight):
    assert flight["on_board"]
    assert flight["outcome"]["reason"] == "landed"
    assert flight["outcome"]["rung"] == "none"
    assert flight["max_deviation"] <= 0.08
    assert {"trajectory memory", "link loss on board", "fall after link loss"} <= {
        check["name"] for check in flight["outcome"]["preflight"]
    }


def test_its_record_says_how_it_was_flown(flight):
    record = read_record(Path(flight["record"]))
    assert record.header.provenance["flown"] == "on board"
    assert "upload" in record.phases.phase
    assert len(record.setpoints.due) > 100
