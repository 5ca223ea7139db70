"""What flies, records and watches goes by its clock, and tests by the stepped one: only named files read real time."""

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "cfplan"
LAYERS = ("flight", "simulation", "recording")
# Modules of those layers that may import `time`, and why.
READ_REAL_TIME = {
    "flight/clock.py": "it is the clock",
    "flight/mocap/child.py": "the driver's process",
    "simulation/lab/sim_driver.py": "in cflib's threads",
    "simulation/dry_run.py": "tells how long it took",
    "recording/rerun/picture.py": "waits for the viewer's process",
    "recording/writer.py": "dates a record by the wall clock",
    "recording/mavlink/bridge.py": "dates a log by the wall clock",
}
IN_REAL_TIME = sorted(TESTS.rglob("test_*_in_real_time.py"))
# The tests that go by the computer's clock, and what only they can show.
REAL_TIME_TESTS = {
    "test_a_flight_goes_by_the_clock_and_ends_landed": "the pilot's process meets its deadlines",
    "test_ctrl_c_at_full_speed_lands_and_twice_cuts_the_motors": "a signal to one process ends the flight of another",
    "test_whichever_process_is_killed_the_vehicle_comes_down": "the system's own end of a process",
    "test_a_fault_in_real_time_comes_to_its_rung_and_the_vehicle_to_the_ground": "drivers and sockets, a stopped pilot",
    "test_without_its_planner_a_flight_ends_on_what_is_committed": "a planner's process that dies or hangs",
    "test_a_vehicle_is_steered_by": "programs and pipes that request waypoints in flight",
    "test_what_requests_in_bursts_lead_to_is_certified_again": "a planner's process that is asked faster than it plans",
    "test_a_flight_ends_disarmed_and_recorded_whatever_is_done_from_outside": "terminals, and a ground station",
    "test_poses_are_where_and_when_the_body_was": "how late poses of the driver's process are",
    "test_a_link_fails_or_closes_soon": "how long a person waits",
    "test_cflib_flies_the_virtual_crazyflie": "cflib's threads go by the computer's clock",
    "test_a_second_terminal_flies_one_of_two_vehicles_by_its_own_poses": "cflib's UDP driver, and a Vicon beside it",
    "test_an_example_of_cflib_flies_and_lands": "programs that others wrote",
    "test_a_fleet_lands_as_it_is_shown": "the command's own processes",
    "test_two_vehicles_start_together_and_land": "several pilots' processes meet one time",
    "test_a_program_flies_a_fleet_as_the_page_shows": "a thread of a program, and the pilots' processes",
    "test_a_fleet_with_addresses_flies_by_the_poses_of_a_motion_capture_system": "UDP, and a Vicon beside it",
    "test_swapped_bodies_are_refused_before_anything_is_armed": "UDP, and a Vicon beside it",
    "test_the_other_brakes_when_the_process_of_a_pilot_is_killed": "the system's own end of one of several processes",
    "test_both_are_lost_and_come_down_when_the_process_of_their_dongle": "the system's own end of a process",
    "test_a_sleeper_notes_its_deadlines_and_how_long_a_process_waits_for_its_processor": "the system's scheduling",
}


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
    found = {file for file in TESTS.rglob("*.py") if imports_time(file)}
    slow = {file for file in found if re.search(r"^pytestmark = .*\bpytest\.mark\.slow\b", file.read_text(), re.M)}
    assert found - slow == {TESTS / "waiting.py"}


@pytest.mark.parametrize("file", IN_REAL_TIME, ids=lambda file: file.stem)
def test_tests_in_real_time_are_slow(file):
    assert re.search(r"^pytestmark = .*\bpytest\.mark\.slow\b", file.read_text(), re.MULTILINE)


def test_some_dozen_tests_go_by_the_computers_clock():
    found = [
        node.name
        for file in IN_REAL_TIME
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]
    assert sorted(found) == sorted(REAL_TIME_TESTS)
    assert len(REAL_TIME_TESTS) == 21
