"""From a path file to a mission: each step once, in order, and what does not pass goes no further."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import InfeasibleError, InputError, NotCertifiedError
from cfplan.flight.setpoints.packets import decode
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.preparation import glitch_assessment, link_loss_assessment
from cfplan.preparation import plan_flight as planning
from cfplan.preparation import prepare_flight as preparation
from cfplan.preparation.plan_flight import FlightOptions, plan_flight
from cfplan.preparation.prepare_flight import encode_flight, find_link_loss, prepare_flight
from cfplan.preparation.steps import StepState
from cfplan.simulation import link_loss
from cfplan.simulation.link_loss import LinkLoss, simulate_link_loss
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

REPOSITORY = Path(__file__).parents[2]
LINE = REPOSITORY / "flights" / "line.yaml"
AFTER_PLANNING = ["certificate", "bytes", "dry run", "link loss", "stops", "slow phases"]

ENDED_WELL = (StepState.FINISHED, StepState.WARNED)


@pytest.fixture
def steps():
    """Notes each report; an OnStep."""
    noted = []

    def note(name, state, result):
        noted.append((name, state, result))

    note.noted = noted
    note.names = lambda *wanted: [name for name, state, _ in noted if state in wanted]
    return note


def test_every_step_is_reported_once_in_the_order_of_the_data(limits, steps):
    prepared = prepare_flight(LINE, limits, on_step=steps)
    order = ["path", "plan", "slowing", *AFTER_PLANNING]
    assert steps.names(StepState.BEGUN) == steps.names(*ENDED_WELL) == order
    assert all(result for _, state, result in steps.noted if state in ENDED_WELL)
    assert prepared.plan.certificate.passed
    assert prepared.dry_run.passed
    assert prepared.mission.payloads is prepared.encoded.payloads
    assert prepared.stops.count == len(prepared.mission.stops) == len(prepared.mission.payloads)
    assert prepared.planned.lower_bound() <= prepared.plan.trajectory.duration


def after_link_loss(limits, monkeypatch, steps, beyond, only_warn) -> None:
    monkeypatch.setattr(preparation, "simulate_link_loss", lambda *_: LinkLoss(1.0, 4.0, beyond))
    limits = replace(limits, link_loss=replace(limits.link_loss, only_warn=only_warn))
    find_link_loss(encode_flight(plan_flight(LINE, limits)), limits, steps)


def test_a_link_loss_that_ends_beyond_the_walls_is_refused(limits, monkeypatch, steps):
    with pytest.raises(NotCertifiedError, match=r"3\.2 m beyond the walls") as caught:
        after_link_loss(limits, monkeypatch, steps, 3.2, only_warn=False)
    assert "outside: warn" in caught.value.hint
    assert steps.names(StepState.FAILED) == ["link loss"]


@pytest.mark.parametrize(("beyond", "state"), [(-0.1, StepState.FINISHED), (3.2, StepState.WARNED)])
def test_where_safety_yaml_says_so_it_is_a_warning(limits, monkeypatch, steps, beyond, state):
    after_link_loss(limits, monkeypatch, steps, beyond, only_warn=True)
    assert steps.names(state) == ["link loss"]


@pytest.fixture
def called(monkeypatch):
    """Notes each call of what encodes, checks and simulates."""
    noted = []
    for module, name in (
        (link_loss_assessment, "link_loss_near_walls"), (glitch_assessment, "glitch_at_sampled_setpoints"),
        (link_loss, "link_loss_at_every_setpoint"), (preparation, "check_bytes"), (preparation, "dry_run"),
        (preparation, "certify_stops"),
    ):  # fmt: skip
        function = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, _f=function, _n=name, **k: noted.append(_n) or _f(*a, **k))
    return noted


IN_PLANNING = ["glitch_at_sampled_setpoints", "link_loss_near_walls"]


def test_nothing_is_simulated_twice(limits, called):
    prepared = prepare_flight(LINE, limits)
    assert sorted(called[:2]) == IN_PLANNING
    assert called[2:] == ["check_bytes", "dry_run", "certify_stops"]
    assert prepared.link_loss == simulate_link_loss(prepared.mission.payloads, limits)


def test_link_loss_is_simulated_anew_for_other_bytes_than_those_of_planning(limits, called):
    prepared = prepare_flight(LINE, limits, FlightOptions(stream_for=6.0))
    assert called[2:] == ["check_bytes", "dry_run", "link_loss_at_every_setpoint", "certify_stops"]
    assert prepared.link_loss == simulate_link_loss(prepared.mission.payloads, limits)


def test_a_plan_file_is_looked_at_whole(limits, tmp_path, called):
    save_plan(plan_flight(LINE, limits).plan, tmp_path / "plan.parquet")
    called.clear()
    prepare_flight(tmp_path / "plan.parquet", limits)
    checked = ["check_bytes", "dry_run", "link_loss_at_every_setpoint", "glitch_at_sampled_setpoints", "certify_stops"]
    assert called == checked


def test_a_plan_file_gives_the_same_bytes_as_its_path_file(limits, tmp_path, steps):
    prepared = prepare_flight(LINE, limits)
    save_plan(prepared.plan, tmp_path / "plan.parquet")
    again = prepare_flight(tmp_path / "plan.parquet", limits, on_step=steps)
    *before, stops, slow = AFTER_PLANNING
    assert steps.names(*ENDED_WELL) == ["plan", *before, "glitches", "link loss of stops", stops, slow]
    np.testing.assert_array_equal(again.mission.payloads, prepared.mission.payloads)
    np.testing.assert_array_equal(again.mission.stops, prepared.mission.stops)
    assert again.planned.was_read
    assert not prepared.planned.was_read


def test_a_plan_of_another_vehicle_is_refused(limits, tmp_path):
    save_plan(plan_flight(LINE, limits).plan, tmp_path / "plan.parquet")
    heavier = replace(limits, airframe=replace(limits.airframe, mass=1.1 * limits.airframe.mass))
    with pytest.raises(InputError, match="planned for"):
        prepare_flight(tmp_path / "plan.parquet", heavier)


def test_a_plan_that_does_not_begin_and_end_at_rest_is_refused(limits, tmp_path):
    made = plan_flight(LINE, limits).plan
    path, at = made.path.part(0.3 * made.path.end, 0.7 * made.path.end), np.linspace(0.0, 1.0, 101)
    nodes, steps = np.zeros_like(at), np.zeros(len(at) - 1)
    steady = SpeedProfile(at * path.end, nodes + 0.2, nodes, nodes, steps, nodes, nodes, steps)
    moving = Trajectory(path, steady, made.airframe)
    save_plan(replace(made, path=path, trajectory=moving, slowing=None), tmp_path / "moving.parquet")
    assert load_plan(tmp_path / "moving.parquet").certificate.passed
    with pytest.raises(InputError, match="at rest"):
        prepare_flight(tmp_path / "moving.parquet", limits)


def test_a_plan_that_outlasts_the_battery_is_refused(limits, tmp_path):
    save_plan(plan_flight(LINE, limits).plan, tmp_path / "plan.parquet")
    emptier = replace(limits, battery=replace(limits.battery, endurance=5.0))
    with pytest.raises(InfeasibleError, match="trusted for 5 s"):
        plan_flight(tmp_path / "plan.parquet", emptier)


def test_a_plan_that_breaks_todays_limits_is_certified_anew_and_not_encoded(limits, tmp_path, steps):
    save_plan(plan_flight(LINE, limits).plan, tmp_path / "plan.parquet")
    stricter = replace(limits, plan=replace(limits.plan, speed=0.8 * limits.plan.speed))
    planned = plan_flight(tmp_path / "plan.parquet", stricter)
    assert not planned.plan.certificate.passed
    with pytest.raises(NotCertifiedError, match="speed"):
        encode_flight(planned, steps)
    assert steps.names(StepState.FAILED) == ["certificate"]


def test_the_path_files_speed_holds_unless_another_is_given(limits, monkeypatch):
    real = planning.load_path_file
    monkeypatch.setattr(planning, "load_path_file", lambda file: replace(real(file), speed=0.7))
    flown = [plan_flight(LINE, limits, FlightOptions(speed_factor=given)).plan.speed_factor for given in (None, 0.5)]
    assert flown == [0.7, 0.5]


def test_a_stream_as_long_as_asked_for_ends_in_a_hover(limits):
    prepared = prepare_flight(LINE, limits, FlightOptions(stream_for=6.0))
    assert 6.0 <= prepared.encoded.duration < 6.03
    after = prepared.encoded.times > prepared.plan.trajectory.duration
    assert not np.any(decode(prepared.encoded.payloads[after]).velocity)


def test_a_path_outside_the_space_fails_at_the_path_with_its_waypoint(limits, tmp_path, steps):
    (tmp_path / "path.yaml").write_text("waypoints: [[0, 0, 1], [3, 0, 1]]\n")
    with pytest.raises(InfeasibleError, match="waypoint 2"):
        prepare_flight(tmp_path / "path.yaml", limits, on_step=steps)
    assert steps.names(StepState.FAILED) == ["path"]
