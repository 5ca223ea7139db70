"""Replanning: proposals that a pilot accepts, checked as if the whole flight had been planned so from its beginning."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.air import certifying
from cfplan.air.certifying import STOP, EndsBadlyError
from cfplan.air.replanning import next_part, replan, replan_behind_stop
from cfplan.air.stopping import halt
from cfplan.air.timeline import LOOKS_BACK, hold, hold_hover, joint_of
from cfplan.errors import CfplanError, InfeasibleError, InputError
from cfplan.flight.setpoints.commitment import Commitment, splice
from cfplan.flight.setpoints.encoding import LEAD, RATE, encode_trajectory
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.continuation import with_room
from cfplan.planning.plan import plan
from cfplan.safety.certificate import certify
from cfplan.simulation.dry_run import fly_motion, rehearse_motion, rehearse_setpoints
from cfplan.simulation.glitches import LATENCY, glitch_at_every_setpoint
from cfplan.simulation.link_loss import as_believed, link_loss_at_every_setpoint

WAYPOINTS = np.array([[-1.0, -2.0, 0.8], [0.8, -1.0, 1.1], [-0.6, 0.6, 0.9], [0.7, 1.8, 1.1]])
NOW = 100  # number of the setpoint that is due when a plan is proposed


@pytest.fixture(scope="module")
def held(limits):
    """A plan with as much room to its limits as plans in the air have."""
    path = min_snap(WAYPOINTS, times=centripetal_times(WAYPOINTS))
    roomy = replace(limits, plan=with_room(limits.plan, limits.airframe))
    return hold(plan(path, limits.airframe, roomy, planner="expert"), WAYPOINTS)


def after(held, limits, replanned, now=NOW):
    committed = splice(held.commitment, replanned.proposal, now, limits)
    assert isinstance(committed, Commitment), str(committed)
    return replanned.accepted(committed)


def encoded_from(timeline, first, limits):
    """The motion of a timeline from a setpoint on, as setpoints."""
    return encode_trajectory(timeline.motion.since(first / RATE), gains=gains_under(limits), space=limits.space)


def test_simulated_on_from_a_snapshot_a_flight_is_the_whole_flight(held, limits):
    """Link loss from setpoint 150 on is to the last digit that of the whole flight, the dry run to 10 µm. Gaps are
    not: the snapshot is of a vehicle that knows its state, which is not ahead by its speed times the lateness.
    """
    payloads, begin = held.commitment.payloads, 150
    whole = link_loss_at_every_setpoint(payloads, limits)
    starts = whole.snapshots[:, begin]
    part = link_loss_at_every_setpoint(payloads[begin:], limits, starts=starts)
    np.testing.assert_array_equal(part.beyond, whole.beyond[begin:])
    np.testing.assert_array_equal(part.snapshots, whole.snapshots[:, begin:])

    believed = as_believed(starts, limits)
    gaps = glitch_at_every_setpoint(payloads, limits)
    np.testing.assert_allclose(
        glitch_at_every_setpoint(payloads[begin:], limits, start=believed).deviation,
        gaps.deviation[:, begin:],
        atol=limits.plan.speed * LATENCY,
    )
    flown, later = held.motion, held.motion.since(begin / RATE)
    at_once = fly_motion(
        encode_trajectory(flown, gains=gains_under(limits), space=limits.space), flown, limits.airframe
    )
    gone_on = fly_motion(
        encode_trajectory(later, gains=gains_under(limits), space=limits.space),
        later,
        limits.airframe,
        snapshot=believed,
    )
    rows = slice(begin * 10, begin * 10 + 2000)
    np.testing.assert_allclose(gone_on.position[:2000], at_once.position[rows], atol=1e-5)


def test_new_waypoints_replace_those_ahead(held, limits):
    made = replan(held, NOW + 5, [[-0.5, 0.8, 1.0], [0.5, 2.0, 1.0]], limits)
    new = after(held, limits, made)
    assert new.commitment.splices == (NOW + 5,)
    end = decode(new.commitment.payloads[-1:])
    np.testing.assert_allclose(end.position, [[0.5, 2.0, 1.0]], atol=5.1e-4)


def test_more_waypoints_follow_those_ahead_without_a_stop(held, limits):
    more = [-0.8, 2.4, 0.9]
    new = after(held, limits, replan(held, NOW + 5, [more], limits, keep=True))
    np.testing.assert_allclose(new.ahead[-2:], [WAYPOINTS[-1], more])
    flown = new.motion.at(np.arange(0.0, new.motion.duration, 0.01))
    for waypoint in WAYPOINTS[1:]:  # still flown through
        assert np.linalg.norm(flown.position - waypoint, axis=1).min() < 0.02
    at_the_old_end = int(np.argmin(np.linalg.norm(flown.position - WAYPOINTS[-1], axis=1)))
    assert np.linalg.norm(flown.velocity[at_the_old_end]) > 0.2
    there = replan(held, held.commitment.last + 1, [more], limits).plan.trajectory.duration
    assert new.ends < held.ends + there - 0.3


def test_after_its_end_the_vehicle_starts_from_rest(held, limits):
    late = held.commitment.last + 300
    new = after(held, limits, replan(held, late, [[0.0, 0.5, 1.0]], limits), now=late - 5)
    state = decode(new.commitment.payloads)
    np.testing.assert_allclose(state.position[0], WAYPOINTS[-1], atol=5.1e-4)
    np.testing.assert_allclose(state.position[-1], [0.0, 0.5, 1.0], atol=5.1e-4)
    new = after(new, limits, replan(new, late + 60, [[0.5, -0.5, 1.0]], limits, keep=True), now=late + 55)
    np.testing.assert_allclose(new.motion.trajectories[-1].path(new.reached), new.ahead, atol=1e-9)


def test_where_link_loss_would_end_outside_the_vehicle_flies_slower(held, limits):
    """Straight at a wall, 25 cm before which the last waypoint lies."""
    far, leave, waypoints = straight_at_a_wall(held, limits)
    slow = replan(far, leave, waypoints, limits)
    speeds = np.linalg.norm(decode(slow.proposal.payloads).velocity, axis=1)
    assert speeds.max() < 1.25
    after(far, limits, slow, now=leave - 5)


def test_in_flight_it_slows_down_to_a_lower_speed_without_a_jump(held, limits):
    first = 120
    made = replan(held.slowed_to(0.8), first, [[-0.4, 1.0, 1.0], [0.4, 2.4, 1.0]], limits)
    after(held, limits, made, first - 5)
    moments = np.arange(0.0, made.plan.trajectory.duration, 0.01)
    speeds = np.linalg.norm(made.plan.trajectory.at(moments).velocity, axis=1)
    before = float(np.linalg.norm(held.motion.at(made.joint).velocity))
    assert speeds[0] == pytest.approx(before, abs=1e-6)
    assert before > 1.0
    assert speeds[len(speeds) // 2 :].max() < 0.81


def test_a_flight_replanned_again_and_again_keeps_every_limit_in_what_was_sent(held, limits):
    """Random waypoints, some 0.4 s apart: each piece that was sent is the encoding of the motion behind it.

    The motions are one without a jump, and what was sent passes the dry run as a whole.
    """
    random = np.random.default_rng(4)
    now, sent, replanned, joined = 20, [], 0, held.motion
    first, encoded = 0, encoded_from(held, 0, limits)  # of the piece that is flown

    def send(until):
        rows = np.minimum(np.arange(len(sent), until), held.commitment.last) - held.commitment.first
        sent.extend(held.commitment.payloads[rows])

    for _ in range(14):
        points = random.uniform([-1.0, -2.2, 0.8], [1.0, 2.2, 1.2], (3, 3))
        try:
            made = replan(held, now + 5, points, limits)
        except InfeasibleError:
            made = None
        if made is not None:
            begin, old = made.proposal.splice, held.motion.at(made.joint)
            send(begin + 1)  # that setpoint is still the old one
            np.testing.assert_array_equal(sent[first + 1 :], encoded.payloads[1 : len(sent) - first])
            held, replanned = after(held, limits, made, now), replanned + 1
            for name in ("position", "velocity", "acceleration", "jerk"):
                jump = getattr(made.plan.trajectory.at(0.0), name) - getattr(old, name)
                assert np.abs(jump).max() < 1e-6, name
            joined, first, encoded = (
                joined.continued(made.joint, made.plan.trajectory),
                begin,
                encoded_from(held, begin, limits),
            )
            assert certify(made.plan.trajectory, limits.plan, limits.space).passed
        now += int(random.integers(25, 55))
        send(now)
    assert replanned >= 8
    send(held.commitment.last + 1)
    np.testing.assert_array_equal(sent[first + 1 :], encoded.payloads[1:])
    whole = encode_trajectory(joined, space=limits.space)
    assert len(sent) == len(whole.payloads)
    places = joined.at(np.arange(len(sent)) / RATE + LEAD).position
    np.testing.assert_allclose(decode(np.array(sent)).position, places, atol=5.1e-4)
    as_sent = replace(whole, payloads=np.array(sent), decoded=decode(np.array(sent)))
    assert rehearse_motion(as_sent, joined, limits.airframe, limits.flight).passed
    assert len(held.motion.trajectories) < len(joined.trajectories)  # what is behind is forgotten


@pytest.mark.parametrize(
    ("waypoints", "error"),
    [
        ([], InputError),
        ([[0, 0]], InputError),
        ([[0, 0, np.nan]], InputError),
        ([[0, 0, 5]], InfeasibleError),
    ],
)
def test_what_cannot_be_flown_is_refused_in_words(held, limits, waypoints, error):
    with pytest.raises(error) as refused:
        replan(held, NOW, waypoints, limits)
    assert isinstance(refused.value, CfplanError)
    assert refused.value.hint


def test_a_slow_flight_is_replaced_before_it_has_left_its_hover(limits):
    """Its joint is where the plan begins: at rest, where the speed has no direction to grow in."""
    hovering = hold_hover((0.0, 0.0, 0.8), 0.0, limits).slowed_to(1.0)
    held = after(hovering, limits, replan(hovering, 30, [[0.5, 1.5, 1.0]], limits), 20)
    again = replan(held, 30, [[-0.5, 1.5, 1.0]], limits)
    after(held, limits, again, 20)
    assert again.plan is not None
    moments = np.linspace(0.0, again.plan.trajectory.duration, 300)
    assert np.linalg.norm(again.plan.trajectory.at(moments).velocity, axis=1).max() == pytest.approx(1.0, abs=0.02)


FAR = [[-0.5, 0.8, 1.0], [0.5, 2.0, 1.0], [-0.8, 0.4, 1.2], [0.8, -1.5, 0.9]]
PART = 80  # setpoints


def in_parts(held, limits, first=NOW + 5):
    """A plan through FAR as it is committed in parts, and what is held with each."""
    made = replan(held, first, FAR, limits, part=PART)
    parts, held = [made], after(held, limits, made, first - 5)
    while held.unfinished:
        made = next_part(held, first, limits, PART)
        parts, held = [*parts, made], after(held, limits, made, first - 5)
    return parts, held


def test_a_plan_that_is_committed_in_parts_is_the_whole_plan_in_the_end(held, limits):
    """To the byte, stops too; and the simulated vehicle at each setpoint is that of the whole."""
    whole = after(held, limits, replan(held, NOW + 5, FAR, limits))
    parts, last = in_parts(held, limits)
    assert len(parts) >= 4
    for name in ("payloads", "stops"):
        np.testing.assert_array_equal(getattr(last.commitment, name), getattr(whole.commitment, name))
    np.testing.assert_array_equal(last.snapshots[:, -len(whole.snapshots[0]) :], whole.snapshots)


def test_each_part_ends_at_rest_inside_and_its_beginning_is_the_plan(held, limits):
    parts, last = in_parts(held, limits)
    first = parts[0].proposal.splice
    plan_bytes = encoded_from(last, first, limits).payloads
    for made in parts[:-1]:
        proposal, part_ends = made.proposal, made.timeline.part_ends
        assert part_ends == proposal.splice + PART
        rows = slice(proposal.splice + 1 - first, part_ends - first)
        np.testing.assert_array_equal(proposal.payloads[1:PART], plan_bytes[rows])
        np.testing.assert_array_equal(proposal.stops[PART], proposal.payloads[PART : PART + STOP + 1])
        worst = link_loss_at_every_setpoint(
            proposal.payloads, limits, starts=made.timeline.snapshots_at(proposal.splice)
        ).worst
        assert worst.beyond <= 0.0


def test_the_first_setpoint_of_a_proposal_is_the_committed_one_and_the_others_are_those_of_its_motion(held, limits):
    for begin in range(NOW, NOW + 60, 10):
        made = replan(held, begin, [[-0.5, 0.8, 1.0], [0.5, 2.0, 1.0]], limits)
        proposal, committed = made.proposal, held.commitment.payloads
        assert proposal.splice == begin
        assert made.joint == joint_of(begin)
        np.testing.assert_array_equal(proposal.payloads[0], committed[begin])
        assert (proposal.payloads[1] != committed[begin + 1]).any()
        encoded = encoded_from(made.timeline, begin, limits)
        np.testing.assert_array_equal(proposal.payloads[1:], encoded.payloads[1:])


def test_where_no_path_leads_on_from_a_joint_the_vehicle_turns_off_a_little_later(held, limits):
    """At the waypoint itself it cannot rest; a little farther on it can turn back."""
    passed = held.motion.at(joint_of(NOW + 5)).position
    made = replan(held, NOW + 5, [passed], limits)
    new = after(held, limits, made)
    assert NOW + 5 < new.commitment.splices[-1] <= NOW + 40
    np.testing.assert_allclose(decode(new.commitment.payloads[-1:]).position[0], passed, atol=1e-3)


def fastest_after(made, seconds=0.0):
    times = np.arange(seconds, made.plan.trajectory.duration, 0.02)
    return np.linalg.norm(made.plan.trajectory.at(times).velocity, axis=1).max()


def straight_at_a_wall(held, limits):
    """A timeline that rests far from a wall, the setpoint from which on it flies, and a waypoint beside the wall."""
    leave = held.commitment.last + 100
    far = after(held, limits, replan(held, leave, [[0.0, -1.0, 1.0]], limits), now=leave - 5)
    return far, far.commitment.last + 100, [[0.0, limits.space.high[1] - 0.25, 1.0]]


def test_what_would_end_badly_far_ahead_is_flown_slower_from_the_beginning_on(held, limits):
    """Of which only the beginning is certified, long before link loss would end outside."""
    far, leave, waypoints = straight_at_a_wall(held, limits)
    made = replan(far, leave, waypoints, limits, part=20)
    assert made.timeline.unfinished
    assert fastest_after(made) < 1.25


def test_what_ends_badly_far_ahead_however_slowly_it_is_flown_is_refused(held, limits, monkeypatch):
    def foresee(*_):
        raise EndsBadlyError("it ends outside", where="link loss")

    monkeypatch.setattr(certifying, "foresee_link_loss", foresee)
    with pytest.raises(EndsBadlyError):
        replan(held, NOW + 5, FAR, limits, part=PART)


def test_where_the_next_part_would_end_badly_the_vehicle_slows_down_before_it(held, limits):
    """The plan was made as if walls did not matter, and its first parts pass in any case."""
    careless = replace(limits, link_loss=replace(limits.link_loss, only_warn=True))
    far, leave, waypoints = straight_at_a_wall(held, limits)
    made = replan(far, leave, waypoints, careless, part=60)
    fast = after(far, limits, made, leave - 5)
    while (more := next_part(fast, fast.part_ends - 40, limits, 20)).plan is None:
        fast = after(fast, limits, more, fast.part_ends - 45)
    assert more.proposal.splice < fast.part_ends
    assert fastest_after(more, 1.0) < 1.25 < fastest_after(made)
    np.testing.assert_allclose(after(fast, limits, more, fast.part_ends - 45).ahead, waypoints)


def test_a_part_that_comes_too_late_goes_on_from_rest(held, limits):
    made = replan(held, NOW + 5, FAR, limits, part=PART)
    first = after(held, limits, made)
    late = first.part_ends + 30
    made = next_part(first, late, limits, PART)
    assert made.proposal.splice == first.part_ends + STOP + LOOKS_BACK  # where it rests
    after(first, limits, made, late - 5)
    np.testing.assert_allclose(made.timeline.ahead, FAR)
    np.testing.assert_allclose(made.plan.path(0.0), first.rest[0])


def test_more_waypoints_asked_for_while_a_plan_is_committed_in_parts_follow_all_of_it(held, limits):
    first = after(held, limits, replan(held, NOW + 5, FAR, limits, part=PART))
    made = replan(first, NOW + 40, [[-0.5, -2.0, 1.0]], limits, keep=True, part=PART)
    np.testing.assert_allclose(made.timeline.ahead, [*FAR, [-0.5, -2.0, 1.0]])
    after(first, limits, made, NOW + 35)


def test_a_stop_on_a_plan_in_parts_is_a_stop_and_nothing_follows_it(held, limits):
    first = after(held, limits, replan(held, NOW + 5, FAR, limits, part=PART))
    stopped = after(first, limits, halt(first, NOW + 40, limits), NOW + 35)
    assert not stopped.unfinished
    assert not first.cut_short(limits, going_on=False).unfinished


def test_after_a_stop_beside_a_wall_a_plan_begins_with_what_is_committed(limits):
    """There a hover leans, so its bytes tell its yaw too coarsely; every plan after such a stop was refused once."""
    wall = np.array(limits.space.high)[0]
    points = np.array([[wall - 0.5, -2.0, 0.9], [wall - 0.45, 2.2, 1.2]])
    flown = plan(
        min_snap(points, times=centripetal_times(points)), limits.airframe, limits, planner="expert", yaw_angle=0.6
    )
    held = hold(flown, points)
    stopped = after(held, limits, halt(held, NOW + 5, limits))
    rests = stopped.stops[-1][1] + 5
    after(stopped, limits, replan(stopped, rests, [[0.0, 0.5, 1.0]], limits), rests - 5)
    in_part = after(held, limits, replan(held, NOW + 5, [[wall - 0.45, 2.0, 1.2]], limits, part=20))
    resting = in_part.for_plans_from(in_part.part_ends + 5, limits)
    first = resting.stops[-1][1] + 5
    after(resting, limits, replan(resting, first, [[0.0, 0.5, 1.0]], limits), first - 5)


@pytest.fixture(scope="module")
def interrupted(held, limits):
    """A plan in parts, the third of which did not pass: the vehicle is to stop behind two, and to go on from there."""
    begun = after(held, limits, replan(held, NOW + 5, FAR, limits, part=PART))
    begun = after(begun, limits, next_part(begun, NOW + 20, limits, PART), NOW + 10)
    return begun.cut_short(limits, going_on=True)


def test_where_a_part_does_not_pass_the_vehicle_stops_before_it_and_goes_on_from_there(interrupted, limits):
    assert interrupted.unfinished
    made = next_part(interrupted, NOW + 30, limits, PART)
    assert made.proposal.splice == interrupted.stops[-1][1]  # long before the vehicle comes there
    assert made.plan is not None
    later = after(interrupted, limits, made, NOW + 25)
    np.testing.assert_allclose(later.ahead[-1], FAR[-1])
    assert not decode(made.proposal.payloads[:1]).velocity.any()
    assert not interrupted.cut_short(limits, going_on=False).unfinished


@pytest.mark.parametrize("planned", [False, True], ids=["before that is planned", "once that is planned"])
def test_other_waypoints_are_flown_at_once_before_such_a_stop(interrupted, limits, planned):
    held = interrupted
    if planned:
        held = after(held, limits, next_part(held, NOW + 30, limits, PART), NOW + 25)
    first = NOW + 40
    made = replan(held, first, [[-0.8, 0.6, 1.1], [0.5, 1.8, 1.0]], limits, part=PART)
    assert made.proposal.splice < first + 36
    new = after(held, limits, made, first - 5)
    begins = made.proposal.splice
    encoded = encoded_from(new, begins, limits)
    np.testing.assert_array_equal(made.proposal.payloads[1:PART], encoded.payloads[1:PART])


@pytest.mark.parametrize("planned", [False, True], ids=["before that is planned", "once that is planned"])
def test_a_stop_is_as_soon_before_such_a_stop_and_nothing_follows_it(interrupted, limits, planned):
    held = interrupted
    if planned:
        held = after(held, limits, next_part(held, NOW + 30, limits, PART), NOW + 25)
    made = halt(held, NOW + 40, limits)
    assert made.proposal.splice == NOW + 40
    assert made.timeline.stops[-1][1] < interrupted.stops[-1][1] - 50
    stopped = after(held, limits, made, NOW + 35)
    assert not stopped.unfinished
    assert stopped.commitment.motion_ends < NOW + 40 + 121


def test_within_a_stop_nothing_is_left_until_it_rests(interrupted, limits):
    within = interrupted.stops[-1][1] - 60
    made = replan(interrupted, within, [[0.0, 0.5, 1.0]], limits)
    assert made.proposal.splice == interrupted.stops[-1][1]


def test_where_no_way_leads_on_from_the_motion_one_leads_on_from_rest_behind_a_stop(held, limits):
    first = NOW + 5
    behind = held.motion.at(first / RATE).position - 0.15 * held.motion.at(first / RATE).velocity
    made = replan_behind_stop(held, first, [behind], limits, part=PART)
    assert made.stop is not None
    assert made.stop.proposal.splice == first
    stopped = after(held, limits, made.stop)
    new = after(stopped, limits, made.behind(stopped.commitment))
    assert new.commitment.splices == (first, stopped.stops[-1][1])
    end = decode(new.commitment.payloads[-1:]).position[0]
    np.testing.assert_allclose(end, behind, atol=1e-3)
    still = stopped.stops[-1][1] - new.commitment.first
    assert not decode(new.commitment.payloads[still : still + 1]).velocity.any()


def test_waypoints_that_follow_a_plan_from_rest_may_be_asked_for_long_before_it_begins(held, limits):
    back = held.motion.at((NOW + 5) / RATE).position - 0.15 * held.motion.at((NOW + 5) / RATE).velocity
    made = replan_behind_stop(held, NOW + 5, [back, [0.6, 0.2, 1.0]], limits)
    stopped = after(held, limits, made.stop)
    turned = after(stopped, limits, made.behind(stopped.commitment))
    more = replan(turned, NOW + 20, [[-0.6, 1.5, 1.1]], limits, keep=True)
    assert more.joint >= turned.motion.starts[-1] > (NOW + 60) / RATE
    new = after(turned, limits, more, NOW + 15)
    np.testing.assert_allclose(new.ahead, [back, [0.6, 0.2, 1.0], [-0.6, 1.5, 1.1]])


def test_a_stop_that_is_asked_for_adds_little_to_how_far_the_vehicle_strays(limits):
    """Over the top of a climb motors come to their ends: what strays a little in the dry run strays much in flight.

    With the longest motor lag it strays much in the dry run, too.
    """
    points = np.array([[-1.0, -2.0, 0.6], [0.0, -0.6, 1.5], [0.2, 1.0, 0.7], [-0.5, 2.0, 1.0]])
    path = min_snap(points, times=centripetal_times(points))
    gentle = plan(path, limits.airframe, limits, planner="expert", speed_factor=0.85)  # a gap loses a faster one
    held = hold(gentle, points)
    sluggish = replace(limits.airframe, motor_time_constant=max(limits.link_loss.motor_lags))
    for begins in (*range(100, 200, 12), 144, 164, 180, 192):
        stop, starts = halt(held, begins, limits), held.snapshots_at(begins)
        as_one_believes = limits.airframe, as_believed(starts, limits), 0.026
        for airframe, start, most in (as_one_believes, (sluggish, starts[-1], 0.161)):
            run = rehearse_setpoints(stop.proposal.payloads, airframe, limits.flight, snapshot=start)
            assert run.passed
            before = np.linalg.norm(start[:3] - held.motion.at(begins / RATE).position)
            assert run.deviation < before + most, (begins, airframe.motor_time_constant)
