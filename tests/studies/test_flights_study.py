"""Flights in real time: failures are counted and listed, the others are measured, and an interrupt keeps them."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import ExitCode, InputError, LinkError
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.outcome import Check, Deviation, FlightOutcome, Rung
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Phase, PhaseEntered, SetpointSent
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.simulation.dry_run import rehearse_motion
from cfplan.simulation.lab.lab import Truth
from studies.flights import STUDY, Settings, without_drag, work
from studies.real_time import LATENESS_CHECK, RETRIES, Conditions, fly_in_real_time
from studies.runner.cases import run_study
from studies.runner.limits import limits_for

pytestmark = pytest.mark.unit
REPOSITORY = Path(__file__).parents[2]
LINE = REPOSITORY / "flights" / "line.yaml"
STILL, LEVEL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
START = 100.0  # s, of the stream
OFF = 0.03  # m, distance of the vehicle from its plan


def outcome(code=ExitCode.OK, failed=(), deviation=OFF):
    checks = tuple(Check(name, "1", "2", passed=False) for name in failed)
    return FlightOutcome(
        code, code.name.lower(), Rung.NONE, checks, (), START, 3.0, Lateness(1e-4, 2e-4, 3e-4, 100, 0),
        Deviation(deviation, deviation / 2, 1.0, 100), 0.1, STILL,
    )  # fmt: skip


class Lab:
    """The part of a lab that the study uses."""

    uri, mocap_uri = "sim://0", "vicon://127.0.0.1:9/cf1"

    def __init__(self, truth):
        self._truth = truth

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def truth(self):
        return self._truth


def study(*ends, files=(LINE,), **settings):
    """Return the study's result for faked flights, which end like `ends` in order, and the conditions of each lab."""
    left, labs = list(ends), []

    def fly(mission, *, on_telemetry, **_):
        end = left.pop(0)
        if isinstance(end, BaseException):
            raise end
        on_telemetry(PhaseEntered(START, Phase.STREAM))
        for index in range(len(mission.payloads)):
            due = START + index / 100
            on_telemetry(SetpointSent(due + 1e-4, due, index, STILL, STILL, STILL, LEVEL, STILL))
        on_telemetry(PhaseEntered(due, Phase.HOLD))
        return end

    def lab(mission, conditions):
        labs.append(conditions)
        sent = decode(mission.payloads)
        time = START + mission.lead + np.arange(len(mission.payloads)) / 100  # setpoints are ahead of the plan
        beside = sent.position + np.array([OFF, 0.0, 0.0])
        zero = np.zeros(len(time))
        return Lab(Truth(time, beside, sent.velocity, sent.quaternion, sent.body_rate, zero, zero, zero, False))

    parts = partial(work, fly=partial(fly_in_real_time, pilot=fly, start=lab))
    result = run_study("flights", "studies.flights", replace(STUDY, work=parts), Settings(files, **settings))
    assert result.interrupted or not left
    return result, labs


def test_each_flight_of_a_path_has_noise_of_its_own_under_the_same_conditions():
    result, labs = study(outcome(), outcome(), repeats=2, loss=0.05, seed=7)
    assert labs == [Conditions(loss=0.05, seed=7), Conditions(loss=0.05, seed=8)]
    assert [flight.seed for flight in result.rows] == [7, 8]


def test_deviation_is_by_poses_and_by_the_truth_and_time_is_that_of_the_setpoints():
    (flight,) = study(outcome(deviation=0.05))[0].rows
    assert flight.deviation_max == 0.05
    assert flight.true_deviation_max == pytest.approx(OFF, abs=1e-3)
    assert flight.streamed == pytest.approx(flight.planned, abs=0.011)
    assert flight.off_plan < 0.01


def test_mean_and_worst_are_over_the_flights_that_landed_and_the_others_are_listed():
    ends = outcome(deviation=0.02), outcome(deviation=0.06), outcome(ExitCode.ENDED_BY_SAFETY), LinkError("gone")
    plans, table, failures = (table.cells() for table in study(*ends, repeats=4)[0].tables)
    assert len(plans[1]) == 1
    assert table[1][-1][:4] == ["all", "2/4", "4.0 cm", "6.0 cm"]
    assert failures[1] == [["line", "2", "ended_by_safety"], ["line", "3", "gone"]]


def test_what_preflight_refuses_for_lateness_alone_is_tried_again_at_most_twice():
    late = outcome(ExitCode.PREFLIGHT, failed=[LATENESS_CHECK])
    (flight,) = study(late, late, outcome())[0].rows
    assert (flight.landed, flight.refusals) == (True, 2)
    (flight,) = study(*[late] * (RETRIES + 1))[0].rows
    assert (flight.landed, flight.refusals) == (False, RETRIES)


def test_any_other_refusal_is_final():
    (flight,) = study(outcome(ExitCode.PREFLIGHT, failed=[LATENESS_CHECK, "battery at rest"]))[0].rows
    assert (flight.landed, flight.refusals) == (False, 0)


def test_a_path_that_cannot_be_planned_does_not_end_the_study(tmp_path):
    outside = tmp_path / "outside.yaml"
    outside.write_text("waypoints: [[0, 0, 1], [0, 50, 1]]\n")
    result, _ = study(outcome(), files=(outside, LINE))
    assert [(flight.path, flight.landed) for flight in result.rows] == [("outside", False), ("line", True)]
    assert "outside" in result.table("not-landed").cells()[1][0][0]


def test_a_file_that_is_no_path_is_an_error_before_anything_flies(tmp_path):
    with pytest.raises(InputError, match=r"gone\.yaml"):
        study(files=(LINE, tmp_path / "gone.yaml"))


def test_the_operators_stop_ends_the_study_and_keeps_what_was_flown():
    result, labs = study(outcome(), outcome(ExitCode.ENDED_BY_OPERATOR), outcome(), repeats=3)
    assert result.interrupted
    assert [flight.landed for flight in result.rows] == [True]
    assert len(labs) == 2


def test_without_drag_compensation_the_dry_run_is_farther_off():
    (plan,) = study(outcome())[0].table("plans").rows
    assert plan["dry_run_without_drag"] > plan["dry_run"] + 0.02  # m; errors of estimator and draws are in both


def test_without_drag_compensation_a_vehicle_that_is_as_planned_deviates_three_times_as_much():
    planned = plan_flight(LINE, limits_for(LINE))
    encoded, motion = encode_flight(planned), planned.plan.trajectory
    deviations = [
        rehearse_motion(flight, motion, planned.limits.airframe, planned.limits.flight).deviation
        for flight in (encoded, without_drag(encoded, motion))
    ]
    assert deviations[1] > 3 * deviations[0]


def test_a_stepped_flight_of_a_drawn_vehicle_lands_within_the_dry_runs_promise():
    settings = Settings((LINE,), loss=0.05, seed=3, drawn=True, stepped=True)
    (flight,) = run_study("flights", "studies.flights", STUDY, settings).rows
    assert flight.landed
    assert flight.late_max < 1e-6
    assert 0.005 < flight.true_deviation_max <= flight.dry_run
    assert flight.within


def test_no_flight_at_all_is_a_table_too():
    assert study(outcome(ExitCode.LINK_LOST))[0].table("flights-by-path").cells()[1][-1][1] == "0/1"


@pytest.mark.parametrize(
    "wrong", [{"loss": 1.0}, {"loss": float("nan")}, {"pose_noise": float("inf")}, {"pose_noise": float("nan")}]
)
def test_conditions_that_cannot_be_are_refused_before_anything_is_planned(wrong, tmp_path):
    with pytest.raises(InputError, match="make no sense"):
        study(files=(tmp_path / "gone.yaml",), **wrong)
