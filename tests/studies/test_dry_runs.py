"""The study of dry runs: deviations from plans of flights/, by motor lag."""

from dataclasses import replace
from pathlib import Path

import pytest

from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight, prepare_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import rehearse_motion
from studies.dry_runs import LAGS, STUDY, Settings
from studies.runner.cases import run_study
from tests.least_snap import along_least_snap

REPOSITORY = Path(__file__).parents[2]
SAFETY = REPOSITORY / "safety.yaml"
MOST = {"line": (1.43, 1.61, 2.00), "random": (1.40, 1.75, 4.21)}  # cm, with all rates sent as rates


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    files = tuple(along_least_snap(name, tmp_path_factory.mktemp(name)) for name in MOST)
    return run_study("dry-runs", "studies.dry_runs", STUDY, Settings(files))


@pytest.mark.parametrize("name", MOST)
def test_no_path_deviates_more_than_with_all_rates_sent_as_rates(name, tmp_path):
    """On one vehicle that knows its true state and has no moment by velocity: these would hide the difference."""
    limits = load_limits(SAFETY)
    limits = replace(limits, airframe=limits.airframe.simplified())
    planned = plan_flight(along_least_snap(name, tmp_path), limits)
    encoded, trajectory = encode_flight(planned), planned.plan.trajectory
    airframes = [replace(limits.airframe, motor_time_constant=lag) for lag in LAGS]
    runs = [rehearse_motion(encoded, trajectory, airframe, limits.flight) for airframe in airframes]
    deviations = [100 * run.deviation for run in runs]
    assert deviations == sorted(deviations)
    for deviation, most in zip(deviations, MOST[name], strict=True):
        assert deviation <= most


def test_slow_motors_stray_farther_in_the_median_than_quick_ones(result):
    for row in result.table("dry-runs").rows:
        medians, worst = ([row[f"deviation_{share}_{lag}_ms"] for lag in (70, 130)] for share in ("median", "95"))
        assert medians == sorted(medians)
        assert worst[0] < 1.01 * worst[1]
        assert all(low < high for low, high in zip(medians, worst, strict=True))


def test_it_is_what_preparation_finds_for_a_vehicle_of_that_lag(result, tmp_path):
    limits = load_limits(SAFETY)
    assert replace(limits.airframe, motor_time_constant=0.105) == limits.airframe
    found = prepare_flight(along_least_snap("line", tmp_path), limits).dry_run
    row = result.table("dry-runs").rows[0]
    assert row["deviation_95_105_ms"] == pytest.approx(found.deviation, abs=1e-9)
    assert row["deviation_median_105_ms"] == pytest.approx(found.deviation_median, abs=1e-9)
