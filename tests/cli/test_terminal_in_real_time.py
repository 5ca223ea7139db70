"""Whole flights that are ended, or not, from outside: each ends disarmed, with a record.

Their terminal is read, stopped, not read, closed or interrupted, or a ground station lands the vehicle.
"""

import json
import os
import pty
import select
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common
from waiting import PATIENCE

from cfplan.errors import ExitCode
from cfplan.recording.importers.formats import read_log
from cfplan.recording.mavlink.bridge import messages_in
from cfplan.recording.reader import read_record

REPOSITORY = Path(__file__).parents[2]
FLY = ("-c", "from cfplan.cli import main; main()", "fly", "flights/line.yaml")
CTRL_C, CTRL_S = b"\x03", b"\x13"
_UNREAD_FOR = 10.0  # s: the flight from take-off on, and more lines than a terminal holds

pytestmark = [pytest.mark.integration, pytest.mark.slow]


class Terminal:
    """A terminal with a flight in it, and a ground station beside it."""

    def __init__(self, *words: str):
        self.station = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.station.bind(("127.0.0.1", 0))
        self.station.settimeout(PATIENCE)
        words = (*words, "--mavlink", f"udp:127.0.0.1:{self.station.getsockname()[1]}")
        self.program, self._screen = pty.fork()
        if self.program == 0:
            os.chdir(REPOSITORY)
            os.execv(sys.executable, [sys.executable, *words])

    def read_until(self, text: str) -> None:
        """Read what the program writes until it writes this."""
        said, end = "", time.monotonic() + 2 * PATIENCE
        while text not in said:
            assert time.monotonic() < end, said
            if select.select([self._screen], [], [], 0.2)[0]:
                said += os.read(self._screen, 4096).decode(errors="replace")

    def type(self, keys: bytes) -> None:
        os.write(self._screen, keys)

    def close(self) -> None:
        os.close(self._screen)

    def read_to_the_end(self) -> None:
        with suppress(OSError):  # the program has ended
            while os.read(self._screen, 4096):
                pass
        self.close()


def stop_output(terminal: Terminal) -> None:
    terminal.type(CTRL_S)
    terminal.read_to_the_end()


def read_nothing(terminal: Terminal) -> None:
    time.sleep(_UNREAD_FOR)
    terminal.read_to_the_end()


def interrupt_twice(terminal: Terminal) -> None:
    terminal.type(CTRL_C)
    terminal.type(CTRL_C)
    terminal.read_to_the_end()


def land_by_ground_station(terminal: Terminal) -> None:
    """Send MAVLink's command to land until it is answered; what was sent to the station so far came to nobody."""
    mav, answers, end = common.MAVLink(None, srcSystem=255, srcComponent=190), [], time.monotonic() + PATIENCE
    while not answers:
        assert time.monotonic() < end
        data, vehicle = terminal.station.recvfrom(2048)
        answers = [one.result for _, one in messages_in(data) if one.get_type() == "COMMAND_ACK"]
        land = mav.command_long_encode(1, 1, common.MAV_CMD_NAV_LAND, 0, 0, 0, 0, 0, 0, 0, 0)
        terminal.station.sendto(land.pack(mav), vehicle)
    assert answers == [common.MAV_RESULT_ACCEPTED]
    terminal.read_to_the_end()


@pytest.mark.parametrize(
    ("words", "phase", "act", "code"),
    [
        (["--on-board"], "upload", Terminal.read_to_the_end, ExitCode.OK),
        ([], "stream", stop_output, ExitCode.OK),
        ([], "take off", read_nothing, ExitCode.OK),
        ([], "stream", Terminal.close, ExitCode.ENDED_BY_OPERATOR),
        ([], "arm", interrupt_twice, ExitCode.ENDED_BY_OPERATOR),
        ([], "stream", land_by_ground_station, ExitCode.ENDED_BY_OPERATOR),
    ],
)
def test_a_flight_ends_disarmed_and_recorded_whatever_is_done_from_outside(
    tmp_path, patient_safety_file, words, phase, act, code
):
    terminal = Terminal(*FLY, *words, "--safety", str(patient_safety_file), "--records", str(tmp_path))
    terminal.read_until(f" s  {phase}\r\n")
    act(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(terminal.program, 0)[1]) == code
    terminal.station.close()
    (folder,) = tmp_path.iterdir()
    record = read_record(folder)
    assert list(record.phases.phase[-2:]) == ["disarm", "closed"]
    assert not record.truncated
    assert record.estimates.position[-1, 2] < 0.05
    assert not record.status.motor[-1].any()
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["outcome"]["exit_code"] == code
    assert (record.header.provenance.get("flown") == "on board") == ("--on-board" in words)
    if code == ExitCode.OK:
        assert summary["max_deviation"] <= 0.08
    log = read_log(folder / "telemetry.tlog")
    subjects = {"vehicle 1", "vehicle 1 odometry"} | ({"vehicle 1 setpoint"} if phase == "stream" else set())
    assert subjects <= {subject.name for subject in log.subjects}
    assert not log.truncated
    assert log.notes == ()
