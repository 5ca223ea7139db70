"""Obstacles count wherever walls do: plans, certificates, link loss, stops, the fence, take-off, landing, the air."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from link_loss_oracle import fly_on
from stepped_flight import fly_stepped

from cfplan.air.certifying import EndsBadlyError
from cfplan.air.replanning import replan
from cfplan.air.timeline import hold, hold_hover
from cfplan.errors import CfplanError, InfeasibleError
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.on_board.fall import falls_from
from cfplan.flight.pilot.abort_monitor import AbortMonitor, Observation
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.preflight import check_plan_inside, check_start_place, check_way_to_start
from cfplan.flight.setpoints.commitment import Commitment, Fault, propose, splice
from cfplan.flight.setpoints.descent import off_walls
from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode, encode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.continuation import check_waypoints
from cfplan.planning.plan import plan
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.preparation.link_loss_assessment import assess_link_loss
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import make_mission, prepare_flight
from cfplan.preparation.slow_motion import require_harmless_slow_motion
from cfplan.safety.certificate import OBSTACLES, certify
from cfplan.safety.limits import Ladder, Limits
from cfplan.safety.space import SIDES, Box, Cylinder
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.link_loss import link_loss_at_every_setpoint
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.vehicle.hover import hover_at

REPOSITORY = Path(__file__).parents[2]
LEVEL = (0.0, 0.0, 0.0, 1.0)
POLE = Cylinder(0.0, 0.0, 0.1, 0.0, 2.0, "pole")
TABLE = Box((-0.5, -0.3, 0.0), (0.5, 0.3, 0.6), 0.4, "table")


def furnished(limits: Limits, *obstacles, only_warn=False) -> Limits:
    lost = replace(limits.link_loss, only_warn=only_warn)
    return replace(limits, space=replace(limits.space, obstacles=obstacles), link_loss=lost)


def from_pole(places):
    """Return the distance from POLE's axis less its radius, m, of places at heights at which it stands."""
    return np.hypot(places[..., 0], places[..., 1]) - POLE.radius


@pytest.fixture(scope="module")
def past_the_pole(limits):
    """A plan that passes the pole 0.25 m beside it."""
    waypoints = [[0.9, -2.0, 1.0], [0.38, 0.0, 1.0], [0.9, 2.0, 1.0]]
    here = furnished(limits, POLE, only_warn=True)
    return plan(min_snap(waypoints), limits.airframe, here, planner="expert")


def test_the_certificate_has_the_distance_to_obstacles_as_a_far_finer_grid_finds_it(past_the_pole):
    found = next(each for each in past_the_pole.certificate.margins if each.name == OBSTACLES)
    path = past_the_pole.path
    nearest = from_pole(path(np.linspace(0.0, path.end, 200_001))).min()
    assert found.passed
    assert nearest - 2e-3 <= found.worst <= nearest + 1e-9
    assert found.limit == past_the_pole.limits.space.margin
    assert from_pole(np.array(found.position)) == pytest.approx(nearest, abs=2e-3)
    assert past_the_pole.trajectory.at(found.time).position == pytest.approx(found.position, abs=1e-6)


def test_the_certificate_of_the_same_flight_fails_where_the_pole_is_thicker(past_the_pole):
    thick = furnished(past_the_pole.limits, replace(POLE, radius=0.2)).space
    certificate = certify(past_the_pole.trajectory, past_the_pole.limits.plan, thick)
    assert [each.name for each in certificate.margins if not each.passed] == [OBSTACLES]


def test_a_path_through_an_obstacle_is_refused_and_so_is_a_waypoint_in_one(limits):
    here = furnished(limits, POLE, TABLE)
    with pytest.raises(InfeasibleError, match=r"inside the obstacle '(pole|table)', .* m too near"):
        plan(min_snap([[0.0, -2.0, 1.0], [0.05, 2.0, 1.0]]), limits.airframe, here)
    with pytest.raises(InfeasibleError, match=r"m too near the obstacle 'pole'") as error:
        check_waypoints(np.array([[1.5, 0.0, 1.0], [0.1, 0.1, 1.0]]), here)
    assert error.value.where == "waypoint 2"


def test_a_plan_file_keeps_the_obstacles(past_the_pole, tmp_path):
    save_plan(past_the_pole, tmp_path / "plan.parquet")
    assert load_plan(tmp_path / "plan.parquet").limits.space == past_the_pole.limits.space


@pytest.mark.parametrize("lag", [0.07, 0.13])
def test_link_loss_comes_as_near_to_an_obstacle_as_a_whole_simulation_does(past_the_pole, lag):
    """Against steps of 1 ms to the floor, without errors of attitude and velocity, whose drift widens what is swept."""
    lost = replace(
        past_the_pole.limits.link_loss, motor_lags=(lag,), attitude_error=0.0, vertical_acceleration_error=0.0,
        velocity_error=0.0,
    )  # fmt: skip
    airframe = replace(past_the_pole.airframe, motor_time_constant=lag)
    here = replace(past_the_pole.limits, link_loss=lost, airframe=airframe)
    sent = encode_trajectory(past_the_pole.trajectory, gains=gains_under(here), space=here.space).payloads
    found = link_loss_at_every_setpoint(sent, here)
    apart = replace(here, space=replace(here.space, obstacles=()))
    np.testing.assert_array_equal(found.low, link_loss_at_every_setpoint(sent, apart).low)
    np.testing.assert_array_equal(found.high, link_loss_at_every_setpoint(sent, apart).high)
    near = np.flatnonzero(found.face >= SIDES)
    assert len(near) > 50
    for last in near[:: len(near) // 6]:
        places = [fly_on(sent, airframe, int(last), lag=lag, off_after=off) for off in (1040, 0)]
        nearest = min(from_pole(each[each[:, 2] > 0.0]).min() for each in places)
        assert -nearest - 0.01 <= found.beyond[last] <= -nearest + 0.15


def test_a_flight_at_an_obstacle_is_slowed_until_link_loss_ends_before_it(limits, tmp_path):
    """Straight at a box and back, which is flown faster where there is none."""
    file = tmp_path / "path.yaml"
    file.write_text("waypoints: [[-1.5, -1.0, 1.0], [0.9, -1.0, 1.0], [-1.5, -0.6, 1.0]]\n")
    here = furnished(limits, Box((1.25, -2.0, 0.0), (1.6, 0.0, 1.8), 0.0, "box"))
    free = plan_flight(file, limits).plan
    told = assess_link_loss(encode_trajectory(free.trajectory, space=limits.space), here)
    assert not told.passed
    assert told.near(told.worst) == "the obstacle 'box'"
    assert "into the obstacle 'box'" in told.describe(told.worst)
    slowed = plan_flight(file, here).plan
    assert any("box" in reason for reason in slowed.slowing.reasons)
    assert slowed.trajectory.duration > free.trajectory.duration
    assert assess_link_loss(encode_trajectory(slowed.trajectory, space=here.space), here, margin=0.0).passed


@pytest.mark.parametrize("only_warn", [False, True])
def test_a_landing_on_an_obstacle_is_refused_even_with_nets(limits, tmp_path, only_warn):
    file = tmp_path / "path.yaml"
    file.write_text("waypoints: [[-1.5, -1.5, 1.0], [-1.5, 1.0, 1.2], [0.0, 0.0, 1.2]]\nspeed: 0.4\n")
    with pytest.raises(CfplanError, match="table"):
        prepare_flight(file, furnished(limits, TABLE, only_warn=only_warn))


def test_the_fence_of_the_abort_monitor_counts_obstacles_at_every_height(limits):
    here = replace(furnished(limits, TABLE), flight=replace(limits.flight, fence=Ladder(0.1, 0.2, 0.4)))
    rungs = []
    for height in (1.0, 0.75, 0.65, 0.5, 0.3):
        seen = Observation(10.0, pose=Pose(10.0, 10.0, (0.0, 0.0, height), LEVEL))
        abort = AbortMonitor(here).gravest(seen)
        rungs.append(Rung.NONE if abort is None else abort.rung)
    # The margin ends 0.8 m high: 0.05 m, 0.15 m, 0.3 m (to the top) and 0.5 m (to a side) into it.
    assert rungs == [Rung.NONE, Rung.NONE, Rung.BRAKE, Rung.LAND, Rung.CUT]


def test_a_vehicle_that_a_gust_drives_at_an_obstacle_brakes_and_lands(past_the_pole, limits):
    """The same gust without the obstacle is flown through. The path keeps 0.23 m from it."""
    waypoints = [[-1.5, 0.6, 1.0], [1.5, 0.6, 1.0]]
    box = Box((-1.0, 0.83, 0.0), (1.0, 1.1, 1.6), 0.0, "box")
    outcomes = []
    for obstacles in ((), (box,)):
        here = furnished(limits, *obstacles, only_warn=True)
        here = replace(here, flight=replace(limits.flight, fence=Ladder(0.03, 0.4, 0.5)))
        made = plan(min_snap(waypoints), limits.airframe, here, planner="expert", speed_factor=0.4)
        lab = SteppedLab(limits.airframe)
        begun = []

        def react(message, lab=lab, begun=begun):
            if type(message).__name__ == "SetpointSent" and message.index >= 150 and not begun:
                begun.append(lab.now)
                lab.disturb(VehicleFault(VehicleFaultKind.GUST, 0.0, 1.0, 4.0))

        encoded = encode_trajectory(made.trajectory, space=here.space)
        mission, _ = make_mission(encoded, here)
        flight = fly_stepped(mission, react, lab=lab)
        outcomes.append((flight.outcome.rung, flight.outcome.reason, flight.truth.position[:, 1].max()))
    assert outcomes[0][0] is Rung.NONE, outcomes
    assert outcomes[1][0] is Rung.BRAKE, outcomes
    assert "fence" in outcomes[1][1]


def snapshot(limits, start, pose=(1.5, 0.0, 0.0), height=0.5):
    mission = SimpleNamespace(limits=limits, take_off_height=height, start=(start, 0.0))
    return SimpleNamespace(mission=mission, poses=[Pose(10.0, 10.0, pose, LEVEL)])


def test_preflight_looks_at_the_column_of_take_off_and_at_the_way_to_the_start(limits):
    lamp = Box((1.3, -0.2, 0.3), (1.7, 0.2, 0.4), 0.0, "lamp")  # between the floor and the take-off height
    under = check_start_place(snapshot(furnished(limits, lamp), (1.5, 1.0, 1.0)))
    assert not under.passed
    assert "lamp" in under.value
    here = furnished(limits, POLE)
    assert check_start_place(snapshot(here, (-1.5, 0.0, 1.0))).passed
    through = check_way_to_start(snapshot(here, (-1.5, 0.0, 1.0)))
    assert not through.passed
    assert "pole" in through.value
    assert check_way_to_start(snapshot(here, (-1.5, 1.5, 1.0), pose=(-1.5, -1.0, 0.0))).passed
    over = snapshot(furnished(limits, TABLE), (-1.5, 0.0, 1.5), height=1.5)
    assert not check_way_to_start(over).passed
    assert check_way_to_start(snapshot(furnished(limits, TABLE, only_warn=True), (-1.5, 0.0, 1.5), height=1.5)).passed


def test_preflight_refuses_a_plan_through_an_obstacle_that_was_put_there_since(past_the_pole):
    encoded = encode_trajectory(past_the_pole.trajectory, space=past_the_pole.limits.space)
    stops = encode_stops(encoded.motion, RATE, space=past_the_pole.limits.space)
    for radius, passed in ((0.1, True), (0.2, False)):
        here = furnished(past_the_pole.limits, replace(POLE, radius=radius))
        mission = SimpleNamespace(limits=here, payloads=encoded.payloads, stops=stops)
        assert check_plan_inside(SimpleNamespace(mission=mission)).passed == passed


def test_take_off_and_ways_of_which_link_loss_is_simulated_leave_out_what_obstacles_stand_in(limits):
    here = furnished(limits, POLE, Box((-2.25, -4.0, 0.0), (-1.75, -3.5, 1.0), 0.0, "box in the corner"))
    path = REPOSITORY / "flights" / "line.yaml"
    mission = prepare_flight(path, limits).mission
    said = []
    require_harmless_slow_motion(replace(mission, limits=here), lambda name, state, result: said.append(result))
    assert "inside the wall" in said[-1]


def test_sinking_blindly_does_not_lead_off_a_wall_at_an_obstacle(limits):
    beside = (2.0, 0.0, 0.8)
    free, _ = off_walls(beside, limits.space)
    assert free < -0.1
    in_the_way = furnished(limits, Box((0.5, -0.5, 0.0), (1.6, 0.5, 0.4)))
    assert off_walls(beside, in_the_way.space) == (0.0, 0.0)


def test_a_fall_comes_as_near_to_an_obstacle_as_its_curve(limits):
    """Motors off at once, or with the longest lag; without errors the curve is p + v t - g t² / 2 + what is left."""
    lost = replace(limits.link_loss, attitude_error=0.0, vertical_acceleration_error=0.0, velocity_error=0.0)
    here = replace(furnished(limits, POLE), link_loss=lost)
    random = np.random.default_rng(3)
    states = np.zeros((200, 3, 3))
    states[:, 0] = random.uniform((-1.5, -1.5, 0.5), (1.5, 1.5, 1.5), (200, 3))
    states[:, 1] = random.uniform(-1.5, 1.5, (200, 3))
    found, time = falls_from(states, here, 0.0), np.linspace(0.0, 1.5, 1501)[:, None]
    by_pole = 0
    for state, beyond, face in zip(states, found.beyond, found.face, strict=True):
        curve = state[0] + time * state[1] - 0.5 * 9.81 * time**2 * [0.0, 0.0, 1.0]
        nearest = from_pole(curve[curve[:, 2] > 0.0]).min()
        assert beyond >= -nearest - 0.01
        by_pole += face >= SIDES
    assert by_pole > 50
    still = np.zeros((1, 3, 3))
    still[0, 0] = 0.5, 0.0, 1.0
    assert falls_from(still, here, 0.0).beyond[0] == pytest.approx(-0.4, abs=1e-6)
    assert falls_from(still, here, 0.05).beyond[0] == pytest.approx(-0.35, abs=1e-6)


# In the air


def held_beside(limits):
    waypoints = np.array([[-1.0, -2.0, 0.8], [1.2, -1.0, 1.1], [1.3, 1.8, 1.1]])
    path = min_snap(waypoints)
    return hold(plan(path, limits.airframe, limits, planner="expert"), waypoints)


@pytest.fixture(scope="module")
def around(limits):
    here = furnished(limits, Cylinder(0.0, 1.0, 0.15, 0.0, 2.0, "pole"))
    return here, held_beside(here)


@pytest.mark.parametrize("target", [(0.0, 1.0, 1.0), (0.2, 1.1, 0.5), (0.3, 1.0, 1.5)])
def test_a_target_in_an_obstacle_or_its_margin_is_refused_in_the_air(around, target):
    here, held = around
    with pytest.raises(InfeasibleError, match="too near the obstacle 'pole'"):
        replan(held, 105, [target], here)
    with pytest.raises(InfeasibleError, match="too near the obstacle 'pole'"):
        hold_hover(target, 0.0, here)


@pytest.mark.parametrize("target", [(-1.3, 1.0, 1.0), (-0.6, 2.4, 1.2), (-1.0, 0.2, 0.9), (0.9, 1.0, 1.0)])
def test_what_is_committed_in_the_air_keeps_the_margin_from_obstacles(around, target):
    """Each setpoint and each stop."""
    here, held = around
    made = replan(held, 105, [target], here)
    committed = splice(held.commitment, made.proposal, 100, here)
    assert isinstance(committed, Commitment), str(committed)
    new = made.accepted(committed)
    for payloads in (new.commitment.payloads, new.commitment.stops.reshape(-1, PAYLOAD_SIZE)):
        places = decode(payloads).position
        assert np.hypot(places[:, 0], places[:, 1] - 1.0).min() >= 0.15 + here.space.margin - 1.1e-3


@pytest.mark.parametrize("in_stop", [False, True])
def test_the_pilot_refuses_motion_through_an_obstacle(limits, in_stop):
    here = furnished(limits, POLE)
    hover = encode_trajectory(hover_at((0.32, 0.0, 1.0), 0.0, 0.6, limits.airframe), space=limits.space)
    stops = encode_stops(hover.motion, RATE, space=limits.space)
    held = Commitment(0, hover.payloads, stops)
    assert isinstance(splice(held, propose(held, 5, hover.payloads, stops), 0, here), Commitment)

    def nearer(payloads):
        """Return the same, moved steadily by 1.5 cm in its middle, which no other rule forbids."""
        told = decode(payloads)
        rise = np.sin(np.linspace(0.0, np.pi, len(payloads)))
        position = told.position.copy()
        position[:, 0] -= 0.035 * rise**4
        velocity = told.velocity.copy()
        velocity[:, 0] = np.gradient(position[:, 0], 1.0 / RATE)
        velocity[[0, -1]] = 0.0
        return encode(replace(told, position=position, velocity=velocity))

    payloads, changed = hover.payloads, stops.copy()
    if in_stop:
        changed[3] = nearer(changed[3])
    else:
        payloads = nearer(payloads)
    answer = splice(held, propose(held, 5, payloads, changed), 0, here)
    assert answer.fault is Fault.SPACE, answer
    assert "too far out" in answer.detail


def test_a_proposal_may_lead_around_an_obstacle_though_a_box_about_it_holds_the_obstacle(past_the_pole):
    here = past_the_pole.limits
    encoded = encode_trajectory(past_the_pole.trajectory, space=here.space)
    stops = encode_stops(encoded.motion, RATE, space=here.space)
    assert from_pole(np.zeros(3)) < 0.0
    held = Commitment(0, encoded.payloads, stops)
    assert isinstance(splice(held, propose(held, 0, encoded.payloads, stops), 0, here), Commitment)


def test_a_hover_over_a_table_is_refused_as_link_loss_ends_on_it(limits):
    with pytest.raises(EndsBadlyError, match="into an obstacle"):
        hold_hover((0.0, 0.0, 1.2), 0.0, furnished(limits, TABLE))
