"""All comparisons with walls agree, in 10,000 random rooms: at the margin, a hair beyond it and well beyond."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cfplan.air.certifying import require_inside
from cfplan.air.timeline import hold_hover
from cfplan.errors import CfplanError, InfeasibleError
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.abort_monitor import AbortMonitor, Observation
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.preflight import check_start_place
from cfplan.flight.setpoints.commitment import Commitment, Fault, propose, splice
from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
from cfplan.flight.setpoints.packets import FullStateSetpoints, encode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.continuation import check_waypoints
from cfplan.planning.plan import plan
from cfplan.safety.certificate import POSITION, WALLS, certify, share_of
from cfplan.safety.limits import Ladder
from cfplan.safety.quantities import AT_LEAST, Quantity
from cfplan.safety.space import TOLERANCE, Space, check_space
from cfplan.simulation.link_loss import LinkLoss
from cfplan.vehicle.hover import hover_at
from cfplan.vehicle.trajectory import Trajectory

ROOMS = 10_000
BEYOND = (0.0, 0.5 * TOLERANCE, 2.0 * TOLERANCE, 0.02)  # m beyond the margin
LEVEL = (0.0, 0.0, 0.0, 1.0)
WALL = Quantity(WALLS, "m", "", "", AT_LEAST, POSITION, 3)


def rooms(count):
    """Yield rooms with round numbers, a place by the margin, that wall's axis and side, and whether it is inside."""
    random = np.random.default_rng(1)
    for number in range(count):
        low, size = np.round(random.uniform(-3.0, 0.0, 3), 2), np.round(random.uniform(1.5, 6.0, 3), 2)
        margin, digits = float(np.round(random.uniform(0.05, 0.3), 3)), int(random.integers(2, 6))
        space = Space(tuple(low.tolist()), tuple((low + size).round(2).tolist()), margin)
        axis, high, beyond = int(random.integers(3)), bool(random.integers(2)), BEYOND[number % len(BEYOND)]
        place = (np.add(space.low, space.high) / 2).round(digits)
        # As a person writes it: wall less margin in decimals, which rounds differently from the computed difference.
        edge = round(space.high[axis] - margin, 3) if high else round(space.low[axis] + margin, 3)
        place[axis] = edge + (beyond if high else -beyond)
        yield space, tuple(place.tolist()), axis, high, beyond <= TOLERANCE


def passes(check, *arguments, **options):
    try:
        check(*arguments, **options)
    except CfplanError:
        return False
    return True


def room_limits(limits, space):
    return replace(limits, space=space, flight=replace(limits.flight, fence=Ladder(0.0, 0.6, 1.0)))


def verdicts(space, place, axis, high, limits):
    """Return, by the name of each check, whether it counts a vehicle at the place as inside."""
    pose = Pose(10.0, 10.0, place, LEVEL)
    seen = Observation(10.0, pose=pose)
    here = np.array(place)
    to_walls = (here - np.array(space.low)).tolist() + (np.array(space.high) - here).tolist()
    half = float(np.subtract(space.high, space.low).min()) / 2
    mission = SimpleNamespace(limits=limits, take_off_height=place[2])
    # Of a vehicle that link loss leaves at the place, with the walls where the margin begins.
    lost = (here[axis] - (space.high[axis] - space.margin)) if high else (space.low[axis] + space.margin - here[axis])
    told = {
        "waypoints": passes(check_waypoints, here[None], limits),
        "certificate": share_of(WALL, min(to_walls), space.margin, half) <= 1.0,
        "start": check_start_place(SimpleNamespace(mission=mission, poses=[pose])).passed,
        "link loss": "inside the walls" in str(LinkLoss(0.0, 0.0, lost)),
        "flight": passes(require_inside, SimpleNamespace(worst=LinkLoss(0.0, 0.0, lost)), limits),
    }
    if high or axis != 2:  # the floor is no fence
        abort = AbortMonitor(limits).gravest(seen)
        told["fence"] = abort is None or abort.rung is Rung.NONE
    return told


def test_a_place_at_the_margin_is_inside_for_all_and_one_beyond_for_none(limits):
    for space, place, axis, high, inside in rooms(ROOMS):
        told = verdicts(space, place, axis, high, room_limits(limits, space))
        assert set(told.values()) == {inside}, (space, place, told)


def straight(space, place, axis):
    """Return the ends of a level way along a wall."""
    along = (axis + 1) % 2
    ends = np.array([place, place])
    ends[:, along] += (-0.3, 0.3)
    return ends


def test_paths_at_the_margin_pass_the_path_check_and_the_certificate(limits, make_profile):
    for space, place, axis, _, inside in rooms(400):
        path = min_snap(straight(space, place, axis))
        profile = make_profile(path.end, np.full(12, 0.2), np.zeros(11))
        walls = certify(Trajectory(path, profile, limits.airframe), limits.plan, space).margins[-1]
        assert walls.name == WALLS
        assert passes(check_space, path, space) == walls.passed == inside, (space, place)


def test_hovers_and_stops_at_the_margin_pass_in_planning_and_in_the_air(limits):
    """Packets round positions to a millimetre, which is tolerated, so places outside are 2 cm beyond here."""
    for space, place, _, _, inside in rooms(16):
        if not inside and not (space.beyond(place) > 0.01).any():
            continue
        here = room_limits(limits, space)
        here = replace(here, link_loss=replace(here.link_loss, only_warn=True))
        assert passes(hold_hover, place, 0.0, here) == inside
        hover = encode_trajectory(hover_at(place, 0.0, 0.05, limits.airframe), space=space)
        stops = encode_stops(hover.motion, RATE, space=space)
        held = Commitment(0, hover.payloads, stops)
        answer = splice(held, propose(held, 5, hover.payloads, stops), 0, here)
        assert isinstance(answer, Commitment) == inside, (space, place, answer)
        if not inside:
            assert answer.fault is Fault.SPACE


def test_a_stop_that_leaves_the_space_half_way_is_refused(limits):
    hover = encode_trajectory(hover_at((0.0, 0.0, 1.0), 0.0, 0.05, limits.airframe), space=limits.space)
    stops = encode_stops(hover.motion, RATE, space=limits.space)
    held = Commitment(0, hover.payloads, stops)
    gone = stops.copy()
    still = np.zeros((1, 3))
    out = FullStateSetpoints(np.array([[9.0, 0.0, 1.0]]), still, still, np.array([LEVEL]), still)
    gone[3, 60] = encode(out)
    answer = splice(held, propose(held, 5, hover.payloads, gone), 0, limits)
    assert answer.fault in (Fault.SPACE, Fault.MOTION)
    assert "of the stop from setpoint 8" in answer.detail


@pytest.mark.parametrize("beyond", [0.0, 2.0 * TOLERANCE])
def test_a_flat_path_at_the_margin_below_the_ceiling_is_planned_and_one_beyond_is_refused_in_one_sentence(
    limits, beyond
):
    low, high = limits.space.low, limits.space.high
    room = replace(limits, space=Space(low, (high[0], high[1], 1.5), 0.15))
    height = 1.35 + beyond
    path = min_snap([[0.0, -1.0, height], [0.3, 0.0, height], [0.0, 1.0, height]])
    if beyond:
        with pytest.raises(InfeasibleError) as refused:
            plan(path, room.airframe, room, planner="minsnap")
        assert len(re.findall("margin", str(refused.value))) == 1
    else:
        assert plan(path, room.airframe, room, planner="minsnap").certificate.passed
