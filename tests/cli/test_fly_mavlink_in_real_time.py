"""`cfplan fly --mavlink`, as a person types it, with a ground station that lands the vehicle on its way."""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from cfplan.recording.importers.formats import read_log
from cfplan.recording.mavlink.bridge import messages_in

REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-c", "from cfplan.cli import main; main()")
LAND = 21

pytestmark = [pytest.mark.integration, pytest.mark.slow]


def fly_and_land(safety_file: Path, records: Path) -> tuple[subprocess.CompletedProcess, int | None]:
    """Fly a line; land once the setpoints have led 0.5 m along it. How the command ended, and the answer to landing."""
    mav, result, first = common.MAVLink(None, srcSystem=255, srcComponent=190), None, None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(0.2)
        place = f"udp:127.0.0.1:{station.getsockname()[1]}"
        words = ["fly", "flights/line.yaml", "--safety", str(safety_file), "--records", str(records)]
        words += ["--mavlink", place, "--json"]
        with subprocess.Popen(
            [*COMMAND, *words], cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        ) as flight:  # fmt: skip
            end = time.monotonic() + 200
            while flight.poll() is None and time.monotonic() < end:
                try:
                    data, vehicle = station.recvfrom(2048)
                except TimeoutError:
                    continue
                for _, message in messages_in(data):
                    if message.get_type() == "POSITION_TARGET_LOCAL_NED":
                        first = first or (message.x, message.y)
                        if result is None and abs(message.x - first[0]) + abs(message.y - first[1]) > 0.5:
                            stop = mav.command_long_encode(1, 1, LAND, 0, 0, 0, 0, 0, 0, 0, 0)
                            station.sendto(stop.pack(mav), vehicle)
                    elif message.get_type() == "COMMAND_ACK":
                        result = message.result
            out, err = flight.communicate(timeout=30)
    return subprocess.CompletedProcess(words, flight.returncode, out, err), result


def test_a_ground_station_ends_a_flight_and_the_record_holds_what_was_said(tmp_path, patient_safety_file):
    ended, result = fly_and_land(patient_safety_file, tmp_path / "records")
    assert ended.returncode == 6, ended.stderr
    assert result == common.MAV_RESULT_ACCEPTED
    document = json.loads(ended.stdout)
    assert document["outcome"]["reason"] == "the operator ended the flight"
    log = read_log(Path(document["record"]) / "telemetry.tlog")
    assert {"vehicle 1", "vehicle 1 odometry", "vehicle 1 setpoint"} <= {subject.name for subject in log.subjects}
    assert not log.truncated
    assert log.notes == ()
