"""The study of public flights: what it predicts of a few of them, held out too; they lie beside the repository."""

import json
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import InputError
from studies.real_flights import HELD_OUT, LADDER, OWN, STUDY, Settings
from studies.real_flights_data import flights_of, read_flight
from studies.runner.cases import run_study

FLIGHTS = Path(__file__).parents[3] / "shared" / "data" / "flights"
FEW = ("brushless00", "brushless04", "brushless22", "brushless26", "log34", "log47", "log148", "brushed02")

needs_flights = pytest.mark.skipif(
    not FLIGHTS.is_dir(), reason="the public flights, ../shared/data/flights, are not here"
)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """A few flights of each family."""
    folder = tmp_path_factory.mktemp("flights")
    for name in FEW:
        for suffix in (".json", ".npz"):
            (folder / name).with_suffix(suffix).symlink_to(FLIGHTS / f"{name}{suffix}")
    return run_study("real-flights", "studies.real_flights", STUDY, Settings(folder)).rows


def of(rows, model):
    return {row.flight: row for row in rows if row.model == model}


@needs_flights
def test_the_controllers_commands_are_those_that_were_logged(rows):
    assert set(of(rows, OWN)) == set(FEW)
    for row in of(rows, OWN).values():
        assert row.commands > 0.95, row.flight


@needs_flights
def test_the_predictions_hold(rows):
    for row in of(rows, OWN).values():
        assert row.near, row
        assert row.largest_near, row
        assert row.correlation > 0.95, row
    mellinger = of(rows, OWN)["brushed02"]
    assert (mellinger.ratio, mellinger.largest_ratio) == pytest.approx((1.0, 1.0), abs=0.1)


@needs_flights
def test_flights_are_predicted_by_others_of_their_family(rows):
    held = of(rows, HELD_OUT)
    assert set(held) == {"brushless04", "brushless22", "log47"}  # every third is one to learn from
    for row in held.values():
        assert row.near, row
        assert row.correlation > 0.95, row


@needs_flights
def test_each_rung_explains_more_and_the_dry_run_of_before_nothing(rows):
    medians = [np.median([row.explained for row in of(rows, rung).values()]) for rung in (LADDER[0], *LADDER[3:])]
    assert medians == sorted(medians)
    assert medians[-1] > 0.9
    assert not any(row.near for row in of(rows, LADDER[0]).values())


@needs_flights
def test_the_vehicles_are_as_measured_by_others(rows):
    vehicles = of(rows, OWN)
    for name in ("brushless00", "brushless22"):
        assert 0.30 < vehicles[name].drag < 0.40  # 1/s
        assert 4e-4 < vehicles[name].roll_moment < 6e-4
        assert 5.5e-4 < vehicles[name].pitch_moment < 7.6e-4
        assert 0.85 < vehicles[name].scale < 1.05
    assert 1.4 < vehicles["log34"].scale < 1.6  # the controller believes 0.64 of it
    assert 1.0 < vehicles["log148"].scale < 1.1


@needs_flights
def test_flights_without_a_known_reference_are_left_out():
    found = flights_of(FLIGHTS)
    assert len(found) == 38
    assert not any(name.startswith("nano") for name in found)
    about = json.loads(found["brushless00"].read_text())
    assert read_flight(found["brushless00"]).mass == about["mass_weighed"]


def test_a_folder_without_flights_is_refused(tmp_path):
    with pytest.raises(InputError, match="no flights") as refused:
        run_study("real-flights", "studies.real_flights", STUDY, Settings(tmp_path))
    assert "index.json" in refused.value.hint
