"""Samples are those of the plan at any rate, and a refused file does not replace a good one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.preparation import export_flight
from cfplan.preparation.export_flight import Form, fit_polynomials, sample_rows, write_samples
from cfplan.preparation.plan_flight import FlightOptions, plan_flight

LINE = Path(__file__).parents[2] / "flights" / "line.yaml"


@pytest.fixture(scope="module")
def agile(limits):
    """A flight whose rates change within the rounding of a sample's time."""
    quick = replace(limits.plan, angular_velocity=20.0, angular_acceleration=300.0, acceleration=9.0)
    fast = replace(limits, plan=quick, link_loss=replace(limits.link_loss, only_warn=True))
    return plan_flight(LINE, fast, FlightOptions(planner="expert"))


@pytest.mark.parametrize("rate", [300.0, 700.0, 1000.0 / 3.0])
def test_times_are_rounded_before_the_states_are_taken(agile, tmp_path, rate):
    assert write_samples(agile, rate, tmp_path / "samples.csv") > 100


def test_no_time_occurs_twice_where_the_last_sample_is_rounded_to_the_end(agile):
    end = agile.plan.trajectory.duration
    rows = sample_rows(agile.plan.trajectory, (60 - 1e-6) / end)
    assert len(rows) >= 60
    assert (np.diff(rows[:, 0]) > 0.0).all()


def test_polynomials_may_not_take_longer_than_the_battery_lasts(limits):
    planned = plan_flight(LINE, limits, FlightOptions(planner="expert"))
    height = limits.space.high[2] - limits.space.low[2]
    around = height / limits.ground.take_off_speed + height / limits.ground.land_speed
    enough = replace(limits.battery, endurance=planned.duration + around + 0.1)
    tight = replace(planned, limits=replace(limits, battery=enough))
    with pytest.raises(InfeasibleError, match="battery"):  # a second more lets the lead fade
        fit_polynomials(tight, Form.MEMORY)


def test_more_samples_are_written_than_a_path_file_may_have(agile, tmp_path):
    write_samples(agile, 1000.0, tmp_path / "samples.csv", wait=40.0)
    assert (tmp_path / "samples.csv").stat().st_size > 4_000_000


def test_samples_that_are_refused_leave_the_old_file(agile, tmp_path, monkeypatch):
    def refuse(*_):
        raise NotCertifiedError("the sample is not that of the plan", where="line 2")

    file = tmp_path / "samples.csv"
    file.write_text("old")
    monkeypatch.setattr(export_flight, "check_samples", refuse)
    with pytest.raises(NotCertifiedError):
        write_samples(agile, 100.0, file)
    assert [each.name for each in tmp_path.iterdir()] == ["samples.csv"]
    assert file.read_text() == "old"
