"""Fleets are rehearsed: what a vehicle deviates by must fit into the distance that the fleet keeps."""

import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.flight.setpoints.encoding import RATE
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.fleet.fleet_file import FleetFile
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.fleet.separation import CLEAR, Stops, separations
from cfplan.planning.plan import plan
from cfplan.preparation.plan_fleet import (
    PlannedFleet,
    certify_separation,
    coordinate_fleet,
    loss_model,
    prepare_fleet,
    rehearse_fleet,
)
from cfplan.preparation.plan_flight import PlannedFlight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.preparation.steps import StepState
from cfplan.simulation.dry_run import dry_run

SKEW = 0.03


@pytest.fixture(scope="module")
def line(limits):
    return plan(min_snap([[-0.6, 0.0, 1.0], [0.6, 0.0, 1.0]]), limits.airframe, limits)


@pytest.fixture(scope="module")
def deviation(line, limits):
    """The 95 % deviation of the line, m."""
    return dry_run(encode_flight(PlannedFlight("line", line, limits)), line.trajectory, limits).deviation


@pytest.fixture
def fleet(line, limits):
    """Two vehicles, one after another on one line, that are certified to keep a distance apart."""

    def make(apart):
        members = (FleetMember("first", line), FleetMember("next", line, 2.0 * line.trajectory.duration))
        return PlannedFleet("row", apart, SKEW, members, separations(members, SKEW), (), members[0].end, limits)

    return make


@pytest.mark.parametrize("rehearsed", [rehearse_fleet, prepare_fleet])
def test_a_fleet_whose_vehicles_deviate_more_than_allowed_is_refused_with_the_distance_needed(
    fleet, deviation, rehearsed
):
    narrow = fleet(CLEAR + 2.0 * deviation - 0.002)
    with pytest.raises(NotCertifiedError) as refused:
        rehearsed(narrow)
    for text in ("first and next", f"{100 * deviation:.1f} cm", f"{100 * deviation - 0.1:.1f} cm"):
        assert text in refused.value.what
    needed = float(re.search(r"apart: ([\d.]+)", refused.value.hint)[1])
    assert needed - 0.01 < CLEAR + 2.0 * deviation <= needed
    assert rehearsed(replace(narrow, apart=needed))


def stops_towards(y: float, by: float) -> Stops:
    """Stops from y towards larger y, across lines along x, for the certificate alone."""
    places = np.zeros((200, 11, 2))
    places[..., 0] = np.linspace(-0.6, 0.6, 200)[:, None]
    places[..., 1] = y + np.linspace(0.0, by, 11)
    return Stops(places, 100.0, 0.0, 0.0)


def test_each_pair_must_keep_apart_on_its_paths_and_in_its_stops(limits):
    """The pair that is nearest in its stops is not the one that is nearest on its paths."""
    lines = {y: plan(min_snap([[-0.6, y, 1.0], [0.6, y, 1.0]]), limits.airframe, limits) for y in (0.0, 1.0, 1.5)}
    members = [FleetMember(f"at {y:g}", planned) for y, planned in lines.items()]
    stops = {0.0: stops_towards(0.0, 0.7), 1.0: stops_towards(1.0, 0.05), 1.5: stops_towards(1.5, 0.0)}
    of_plan = {id(planned): stops[y] for y, planned in lines.items()}
    fleet = FleetFile("row", (), 0.25, SKEW)
    found = certify_separation(fleet, members, lambda planned: of_plan[id(planned)])
    assert [(each.pair, each.braked) for each in found] == [
        (("at 0", "at 1"), True), (("at 1", "at 1.5"), True), (("at 0", "at 1.5"), True),
    ]  # fmt: skip
    assert [each.distance for each in found] == pytest.approx([0.3, 0.45, 0.8], abs=0.06)
    with pytest.raises(NotCertifiedError, match=r"at 0 and at 1 .*when all brake"):
        certify_separation(replace(fleet, apart=0.35), members, lambda planned: of_plan[id(planned)])


def test_a_tube_contains_vehicles_that_are_as_far_off_their_path_as_allowed_when_they_are_lost(line, limits):
    apart = 0.33
    boxes = loss_model(FleetFile("row", (), apart, SKEW), limits).tube(line).boxes
    times = np.minimum(np.arange(boxes.shape[1]) / RATE, line.trajectory.duration)
    y, off = line.trajectory.at(times).position[:, 1], (apart - CLEAR) / 2.0 - 1e-9
    for way in boxes[:, :, 0, :, 1]:  # its motors stop at once, or it flies on
        assert (way[:, 0] <= y - off).all()
        assert (way[:, 1] >= y + off).all()


def test_the_tube_of_a_vehicle_that_waits_contains_a_fall_from_the_hover_after_take_off(limits):
    low = plan(min_snap([[-0.6, 0.0, 0.3], [0.6, 0.0, 0.3]]), limits.airframe, limits)
    tubes = {}
    for height in (0.3, 1.5):
        high = replace(limits, ground=replace(limits.ground, take_off_height=height))
        tubes[height] = loss_model(FleetFile("row", (), 0.33, SKEW), high).tube(low).boxes
    first, last = tubes[0.3][:, 0], tubes[1.5][:, 0]
    assert (last[:, : first.shape[1], 0] <= first[:, :, 0] + 1e-9).all()
    assert (last[:, : first.shape[1], 1] >= first[:, :, 1] - 1e-9).all()
    assert last[..., 0, 1].min() < first[..., 0, 1].min() - 0.03
    parts = tubes[0.3].shape[2]
    np.testing.assert_array_equal(tubes[1.5][:, 1:, :parts], tubes[0.3][:, 1:])


def test_a_vehicle_that_hovers_until_all_have_taken_off_must_not_fly_longer_than_its_battery_lasts(line, limits):
    ground, height = limits.ground, limits.space.high[2] - limits.space.low[2]
    alone = line.trajectory.duration + height / ground.take_off_speed + height / ground.land_speed
    apart = plan(min_snap([[-0.6, 2.0, 1.0], [0.6, 2.0, 1.0]]), limits.airframe, limits)
    members = [FleetMember("first", line), FleetMember("next", apart)]
    for seconds, enough in ((5.0, True), (0.1, False)):
        tired = replace(limits, battery=replace(limits.battery, endurance=alone + seconds))
        with nullcontext() if enough else pytest.raises(InfeasibleError, match=r"first: .*the battery is trusted"):
            coordinate_fleet(FleetFile("row", (), 0.33, SKEW), members, tired, None)


@pytest.fixture(scope="module")
def beside_a_wall(limits):
    """Two vehicles along the wall y = 4 m; the nearer is 0.5 m from it, and the other walls are farther."""
    flown = {y: plan(min_snap([[-0.6, y, 1.0], [0.6, y, 1.0]]), limits.airframe, limits) for y in (3.5, 2.5)}
    return [FleetMember(f"at {y:g}", planned) for y, planned in flown.items()]


@pytest.mark.parametrize(("velocity_error", "warned"), [(0.1, True), (0.05, False)])
def test_a_path_nearer_to_a_wall_than_a_vehicle_without_poses_drifts_is_warned_of(
    beside_a_wall, limits, velocity_error, warned
):
    """In 2 s it drifts 0.34 m by 1° of attitude error, and 0.2 m or 0.1 m by the error of its velocity."""
    steps = {}
    precise = replace(limits, link_loss=replace(limits.link_loss, velocity_error=velocity_error))
    fleet = FleetFile("beside a wall", (), 0.35, SKEW)
    coordinate_fleet(
        fleet, beside_a_wall, precise, loss_model(fleet, precise),
        lambda name, state, result: steps.update({name: (state, result)}),
    )  # fmt: skip
    state, result = steps["walls"]
    assert state is (StepState.WARNED if warned else StepState.FINISHED)
    assert "at 3.5 comes within 0.50 m of the wall y = 4 m" in result
    assert ("0.54 m" in result) == warned
