"""The study of dry runs: deviations from plans of flights/, by motor lag."""

from dataclasses import replace
from pathlib import Path

import pytest

from cfplan.preparation.prepare_flight import prepare_flight
from cfplan.safety.limits_file import load_limits
from studies.dry_runs import STUDY, Settings
from studies.runner.cases import run_study
from tests.least_snap import along_least_snap

REPOSITORY = Path(__file__).parents[2]
SAFETY = REPOSITORY / "safety.yaml"
MOST = {"line": (1.43, 1.61, 2.00), "random": (1.40, 1.75, 4.21)}  # cm, with all rates sent as rates


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    files = tuple(along_least_snap(name, tmp_path_factory.mktemp(name)) for name in MOST)
    return run_study("dry-runs", "studies.dry_runs", STUDY, Settings(files))


def test_no_path_deviates_more_than_with_all_rates_sent_as_rates(result):
    for row in result.table("dry-runs").rows:
        deviations = [row[f"deviation_{lag}_ms"] for lag in (70, 105, 130)]
        assert deviations == sorted(deviations)
        for deviation, most in zip(deviations, MOST[row["path"]], strict=True):
            assert 100 * deviation <= most


def test_it_is_what_preparation_finds_for_a_vehicle_of_that_lag(result, tmp_path):
    limits = load_limits(SAFETY)
    assert replace(limits.airframe, motor_time_constant=0.105) == limits.airframe
    found = prepare_flight(along_least_snap("line", tmp_path), limits).dry_run.deviation
    assert result.table("dry-runs").rows[0]["deviation_105_ms"] == pytest.approx(found, abs=1e-9)
