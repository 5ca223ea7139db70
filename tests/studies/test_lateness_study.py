"""Lateness of a sleeper and of the stream, with and without SCHED_FIFO; dropping the permission is final."""

import math
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from cfplan.errors import ExitCode, InputError
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.outcome import Deviation, FlightOutcome, Rung
from cfplan.flight.telemetry import SetpointSent
from studies.lateness import FIRST, ORDINARY, STUDY, Settings, WakeUps, open_view, work
from studies.real_time import RealTimeFlight
from studies.runner.cases import run_study

REPOSITORY = Path(__file__).parents[2]
STILL, LEVEL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)

GIVES_UP = """
import subprocess, sys
from studies.lateness import give_up_priority
give_up_priority()
sys.exit(subprocess.run([sys.executable, "-c",
    "import sys; from cfplan.flight import real_time; sys.exit(real_time.may_use_fifo_scheduling())"]).returncode)
"""


def refused(reason):
    return RealTimeFlight(None, reason)


class KnownSleeper:
    """A sleeper that is 3 ms late at each deadline of 100 Hz, and has no process to watch."""

    def __init__(self, rate, *, first):
        self.rate, self.first = rate, first

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def watch(self, process):
        pass

    def late(self, begin=0.0, end=0.1):
        return [3e-3] * math.floor((end - begin) * self.rate + 1.5)  # both ends count

    def queued(self, begin, end):
        return []


def streamed(late, skipped):
    """Return a flight that streamed for 0.2 s, with each setpoint late by `late`."""
    due = [100.0 + index / 100 for index in range(20)]
    sent = [SetpointSent(when + late, when, index, *[STILL] * 3, LEVEL, STILL) for index, when in enumerate(due)]
    outcome = FlightOutcome(
        ExitCode.OK, "landed", Rung.NONE, (), (), due[0], 0.2, Lateness(late, late, late, 20, skipped),
        Deviation(0.0, 0.0, 0.0, 0), 0.0, STILL,
    )  # fmt: skip
    return RealTimeFlight(outcome, "landed", sent=sent)


def study(*flights, permitted=True):
    """Run the study on faked flights, without dropping the priority, which other tests may need."""
    ends, given_up = list(flights), []
    parts = partial(
        work, fly=lambda *_, **__: ends.pop(0), sleeper=KnownSleeper, permitted=lambda: permitted,
        give_up=lambda: given_up.append(True),
    )  # fmt: skip
    settings = Settings(REPOSITORY / "flights" / "line.yaml", 0.1)
    result = run_study("lateness", "studies.lateness", replace(STUDY, work=parts), settings)
    assert given_up
    assert all(len(row) == len(result.tables[0].cells()[0]) for row in result.tables[0].cells()[1])
    return result


def test_a_sleeper_stands_before_each_stream_and_beside_it_over_the_same_seconds():
    rows = study(streamed(1e-3, 3), streamed(2e-3, 0)).rows
    assert [(row.what, row.priority, row.count, row.skipped) for row in rows] == [
        ("asleep, nothing else", FIRST, 11, 0), ("stream", FIRST, 20, 3), ("asleep meanwhile", FIRST, 20, 0),
        ("asleep, nothing else", ORDINARY, 11, 0), ("stream", ORDINARY, 20, 0), ("asleep meanwhile", ORDINARY, 20, 0),
    ]  # fmt: skip
    assert [row.p50 for row in rows] == pytest.approx([3e-3, 1e-3, 3e-3, 3e-3, 2e-3, 3e-3])


def test_percentiles_are_those_of_the_setpoints():
    late = [1e-4] * 990 + [2e-3] * 10
    row = WakeUps.of("stream", FIRST, late)
    assert (row.count, row.above, row.max) == (1000, 10, 2e-3)
    assert row.p50 == 1e-4
    assert row.p999 == pytest.approx(2e-3)
    assert row.seconds == 10.0


def test_a_flight_that_failed_is_listed_with_its_reason():
    result = study(refused("the vehicle is gone"), refused("too late"))
    assert [row.reason for row in result.rows] == ["", "the vehicle is gone", "", "too late"]
    assert "the vehicle is gone" in result.tables[0].cells()[1][1]


def test_where_it_is_not_permitted_to_go_first_the_rest_is_measured():
    rows = study(refused("too late"), permitted=False).rows
    assert rows[0].reason == "not permitted here"
    assert [row.priority for row in rows[1:]] == [ORDINARY, ORDINARY]


def test_after_giving_priority_up_no_child_can_have_it():
    assert subprocess.run([sys.executable, "-c", GIVES_UP], check=False, timeout=60).returncode == 0


@pytest.mark.parametrize("shortened", [{"reason": "poses stopped"}, {"view_failure": "the live view ended: closed"}])
def test_a_stream_or_view_that_ends_early_is_measured_until_then_with_its_reason(shortened):
    row = replace(WakeUps.of("stream", ORDINARY, [1e-4] * 300), **shortened)
    (table,) = STUDY.tables(None, [row])
    assert {"3 s", *shortened.values()} <= set(table.cells()[1][0])


def test_a_viewer_that_does_not_run_is_an_error_and_no_quieter_computer():
    with pytest.raises(InputError, match="graphics driver"), open_view(None, "/bin/false"):
        pass
