"""Lateness: of a sleeper and of the stream, with and without going first; who gives that up has given it up."""

import json
import os
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import pytest

from cfplan.errors import ExitCode, InputError
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.outcome import Deviation, FlightOutcome, Rung
from cfplan.flight.telemetry import SetpointSent
from cfplan.studies import lateness
from cfplan.studies.lateness import FIRST, ORDINARY, WakeUps, lateness_study, lateness_table
from cfplan.studies.real_time import RealTimeFlight
from cfplan.studies.sleeper import Sleeper

REPOSITORY = Path(__file__).parents[2]
STILL, LEVEL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)

GIVES_UP = """
import subprocess, sys
from cfplan.studies.lateness import give_up_priority
give_up_priority()
sys.exit(subprocess.run([sys.executable, "-c",
    "import sys; from cfplan.flight import real_time; sys.exit(real_time.may_use_fifo_scheduling())"]).returncode)
"""


def measured(result):
    names = [field.name for field in fields(WakeUps)]
    return [WakeUps(**{name: row[name] for name in names if name in row}) for row in result.table("lateness").rows]


def refused(reason):
    return lambda: RealTimeFlight(None, reason)


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


@pytest.fixture
def study(monkeypatch):
    """The study with flights that are not flown; nothing is given up, as other tests may need it."""
    given_up, flights = [], []
    monkeypatch.setattr(lateness, "give_up_priority", lambda: given_up.append(True))
    monkeypatch.setattr(lateness, "fly_in_real_time", lambda *_, **__: flights.pop(0)())

    def run(*ends, permitted=True):
        monkeypatch.setattr(lateness, "may_use_fifo_scheduling", lambda: permitted)
        flights.extend(ends)
        result = lateness_study(REPOSITORY / "flights" / "line.yaml", REPOSITORY / "safety.yaml", 0.1)
        assert given_up == [True]
        return result

    return run


def test_percentiles_are_those_of_the_setpoints():
    late = [1e-4] * 990 + [2e-3] * 10
    row = WakeUps.of("stream", FIRST, late)
    assert (row.count, row.above, row.max) == (1000, 10, 2e-3)
    assert row.p50 == 1e-4
    assert row.p999 == pytest.approx(2e-3)
    assert row.seconds == 10.0


def test_a_sleeper_stands_before_each_stream_and_beside_it_over_the_same_seconds(study):
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
@pytest.mark.integration
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


def test_what_did_not_fly_is_told(study):
    result = study(refused("the vehicle is gone"), refused("too late"))
    assert [row.reason for row in measured(result)] == ["", "the vehicle is gone", "", "too late"]
    titles, cells = result.table("lateness").cells()
    assert all(len(row) == len(titles) for row in cells)


def test_where_it_is_not_permitted_to_go_first_the_rest_is_measured(study):
    result = study(refused("too late"), permitted=False)
    assert measured(result)[0].reason == "not permitted here"
    assert [row.priority for row in measured(result)[1:]] == [ORDINARY, ORDINARY]


def test_after_giving_priority_up_no_child_can_have_it():
    assert subprocess.run([sys.executable, "-c", GIVES_UP], check=False, timeout=60).returncode == 0


def test_a_stream_that_ends_early_is_measured_as_far_as_it_came():
    row = replace(WakeUps.of("stream", ORDINARY, [1e-4] * 300), reason="poses stopped")
    assert {"3 s", "poses stopped"} <= set(lateness_table([row]).cells()[1][0])


def test_a_live_view_that_ended_early_is_told():
    row = replace(WakeUps.of("stream", ORDINARY, [1e-4] * 300), view_failure="the live view ended: closed")
    assert {"3 s", "the live view ended: closed"} <= set(lateness_table([row]).cells()[1][0])


def test_a_viewer_that_does_not_run_is_an_error_and_no_quieter_computer(monkeypatch):
    monkeypatch.setattr(lateness, "viewer_program", lambda: "/bin/false")
    with pytest.raises(InputError, match="graphics driver"), lateness._view(None):
        pass
