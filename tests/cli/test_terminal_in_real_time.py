"""Whole flights from a terminal that is stopped, not read, closed or interrupted: each ends disarmed, with a record."""

import json
import os
import pty
import select
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from waiting import PATIENCE

from cfplan.errors import ExitCode
from cfplan.recording.reader import read_record

REPOSITORY = Path(__file__).parents[2]
FLY = ("-c", "from cfplan.cli import main; main()", "fly", "flights/line.yaml")
CTRL_C, CTRL_S = b"\x03", b"\x13"
_UNREAD_FOR = 10.0  # s: the flight from take-off on, and more lines than a terminal holds

pytestmark = [pytest.mark.integration, pytest.mark.slow]


class Terminal:
    """A terminal with a program in it."""

    def __init__(self, *words: str):
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


@pytest.mark.parametrize(
    ("phase", "act", "code"),
    [
        ("stream", stop_output, ExitCode.OK),
        ("take off", read_nothing, ExitCode.OK),
        ("stream", Terminal.close, ExitCode.ENDED_BY_OPERATOR),
        ("arm", interrupt_twice, ExitCode.ENDED_BY_OPERATOR),
    ],
)
def test_a_flight_ends_disarmed_and_recorded_whatever_its_terminal_does(
    tmp_path, patient_safety_file, phase, act, code
):
    terminal = Terminal(*FLY, "--safety", str(patient_safety_file), "--records", str(tmp_path))
    terminal.read_until(f" s  {phase}\r\n")
    act(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(terminal.program, 0)[1]) == code
    (folder,) = tmp_path.iterdir()
    record = read_record(folder)
    assert list(record.phases.phase[-2:]) == ["disarm", "closed"]
    assert not record.truncated
    assert record.estimates.position[-1, 2] < 0.05
    assert not record.status.motor[-1].any()
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["outcome"]["exit_code"] == code
