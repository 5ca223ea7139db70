"""What flies, records and watches goes by its clock, and tests by the stepped one: only named files read real time."""

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "cfplan"
FUZZING = TESTS / "fuzzing"  # a program that looks for hangs; its tests are slow
LAYERS = ("flight", "simulation", "recording")
# Modules of those layers that may import `time`, and why.
READ_REAL_TIME = {
    "flight/clock.py": "it is the clock",
    "flight/mocap/child.py": "the driver's process",
    "flight/mocap/datastream_client.py": "in the driver's process",
    "flight/mocap/sdk.py": "in the driver's process",
    "flight/mocap/feed.py": "looks after the driver's process",
    "simulation/lab/sim_driver.py": "in cflib's threads",
    "simulation/dry_run.py": "tells how long it took",
    "recording/rerun/picture.py": "waits for the viewer's process",
    "recording/writer.py": "dates a record by the wall clock",
    "recording/mavlink/bridge.py": "dates a log by the wall clock",
}
IN_REAL_TIME = sorted(TESTS.rglob("test_*_in_real_time.py"))


def imports_time(file: Path) -> bool:
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import) and any(alias.name == "time" for alias in node.names):
            return True
        if isinstance(node, ast.ImportFrom) and node.module == "time":
            return True
    return False


def test_what_flies_records_or_watches_asks_its_clock():
    found = {
        file.relative_to(PACKAGE).as_posix()
        for layer in LAYERS
        for file in (PACKAGE / layer).rglob("*.py")
        if imports_time(file)
    }
    assert found == set(READ_REAL_TIME)


def test_only_slow_tests_read_the_computers_clock():
    found = {file for file in TESTS.rglob("*.py") if imports_time(file) and FUZZING not in file.parents}
    slow = {file for file in found if re.search(r"^pytestmark = .*\bpytest\.mark\.slow\b", file.read_text(), re.M)}
    assert found - slow == {TESTS / "waiting.py"}


@pytest.mark.parametrize("file", IN_REAL_TIME, ids=lambda file: file.stem)
def test_tests_in_real_time_are_slow(file):
    assert re.search(r"^pytestmark = .*\bpytest\.mark\.slow\b", file.read_text(), re.MULTILINE)
