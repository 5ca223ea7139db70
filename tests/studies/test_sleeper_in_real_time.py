"""A sleeper measures what the computer does to every program."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cfplan.errors import ExitCode
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.outcome import Deviation, FlightOutcome, Rung
from cfplan.flight.telemetry import SetpointSent
from cfplan.studies.lateness import FIRST, ORDINARY
from cfplan.studies.real_time import RealTimeFlight
from cfplan.studies.sleeper import Sleeper

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[2]
STILL, LEVEL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def streamed(late):
    """A flight that streams for a fifth of a second, each setpoint late by as much."""
    begin = time.monotonic()
    time.sleep(0.2)
    due = [begin + index / 100 for index in range(20)]
    sent = [SetpointSent(when + late, when, index, *[STILL] * 3, LEVEL, STILL) for index, when in enumerate(due)]
    outcome = FlightOutcome(
        ExitCode.OK, "landed", Rung.NONE, (), (), begin, 0.2, Lateness(late, late, late, 20, 3),
        Deviation(0.0, 0.0, 0.0, 0), 0.0, STILL,
    )  # fmt: skip
    return RealTimeFlight(outcome, "landed", sent=sent)


def test_a_sleeper_stands_before_each_stream_and_beside_it_over_the_same_seconds(study, measured):
    result = study(lambda: streamed(1e-3), lambda: streamed(2e-3))
    assert [(row.what, row.priority) for row in measured(result)] == [
        (what, priority)
        for priority in (FIRST, ORDINARY)
        for what in ("asleep, nothing else", "stream", "asleep meanwhile")
    ]
    alone, stream, meanwhile = measured(result)[:3]
    assert stream.p50 == pytest.approx(1e-3)
    assert stream.skipped == 3
    assert 5 <= alone.count <= 100
    assert 15 <= meanwhile.count <= 20
    titles, cells = result.table("lateness").cells()
    assert all(len(row) == len(titles) for row in cells)
    json.dumps(result.to_json(), allow_nan=False)


@pytest.mark.skipif(not Path("/proc/self/schedstat").is_file(), reason="this system does not tell who waits")
def test_a_process_that_waits_for_its_processor_is_seen_to_wait():
    processor = {min(os.sched_getaffinity(0))}
    busy = "import time; end = time.monotonic() + 1.5\nwhile time.monotonic() < end: pass"
    commands = [[sys.executable, "-c", f"import os; os.sched_setaffinity(0, {processor})\n{busy}"]] * 2
    with Sleeper(100.0, first=False) as sleeper:
        first, second = (subprocess.Popen(command) for command in commands)  # both on one processor
        sleeper.watch(first.pid)
        begin = time.monotonic() + 0.4
        time.sleep(1.0)
        end = time.monotonic()
        first.wait()
        second.wait()
        waited = sum(sleeper.queued(begin, end))
        assert 0.2 * (end - begin) < waited < 0.9 * (end - begin)
        assert sleeper.queued(end + 5.0, end + 6.0) == []
