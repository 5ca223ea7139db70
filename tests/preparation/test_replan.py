"""Replanning: proposals that a pilot accepts, checked as if the whole flight had been planned so from its beginning."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import CfplanError, InfeasibleError, InputError
from cfplan.flight.setpoints.commitment import Commitment, splice, spliced
from cfplan.flight.setpoints.encoding import RATE, check_bytes, encode_trajectory
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.continuation import TooLateError, Ways, continue_plan
from cfplan.planning.plan import plan
from cfplan.preparation import certified_flight
from cfplan.preparation import replan as replanning
from cfplan.preparation.certified_flight import EndsBadlyError, UnfoundedError
from cfplan.preparation.replan import (
    CLOSE,
    LOOKS_BACK,
    LOSES,
    AnswerAttempt,
    accepted,
    after_failure,
    at_pace,
    at_rest_from,
    following,
    given_up,
    go_on,
    halt,
    hold,
    hold_hover,
    replan,
    replan_behind_stop,
    slowed_ahead,
    snapshots_at,
)
from cfplan.safety.certificate import certify
from cfplan.simulation.dry_run import dry_run, rehearse_setpoints
from cfplan.simulation.glitches import glitch_at_every_setpoint
from cfplan.simulation.link_loss import as_believed, link_loss_at_every_setpoint

WAYPOINTS = np.array([[-1.0, -2.0, 0.8], [0.8, -1.0, 1.1], [-0.6, 0.6, 0.9], [0.7, 1.8, 1.1]])
NOW = 100  # number of the setpoint that is due when a plan is proposed


@pytest.fixture(scope="module")
def held(limits):
    path = min_snap(WAYPOINTS, times=centripetal_times(WAYPOINTS))
    return hold(plan(path, limits.airframe, limits, planner="expert"), WAYPOINTS)


def after(held, limits, replanned, now=NOW):
    committed = splice(held.commitment, replanned.proposal, now, limits)
    assert isinstance(committed, Commitment), str(committed)
    return accepted(replanned, committed)


def test_simulated_on_from_a_snapshot_a_flight_is_the_whole_flight(held, limits):
    """Link loss and gaps from setpoint 150 on are to the last digit those of the whole flight, the dry run to 10 µm."""
    payloads, begin = held.commitment.payloads, 150
    whole = link_loss_at_every_setpoint(payloads, limits)
    starts = whole.snapshots[:, begin]
    part = link_loss_at_every_setpoint(payloads[begin:], limits, starts=starts)
    np.testing.assert_array_equal(part.beyond, whole.beyond[begin:])
    np.testing.assert_array_equal(part.snapshots, whole.snapshots[:, begin:])

    believed = as_believed(starts, limits)
    gaps = glitch_at_every_setpoint(payloads, limits)
    np.testing.assert_array_equal(
        glitch_at_every_setpoint(payloads[begin:], limits, start=believed).deviation, gaps.deviation[:, begin:]
    )
    flown, later = held.flown, held.flown.since(begin / RATE)
    at_once = dry_run(encode_trajectory(flown, space=limits.space), flown, limits.airframe, limits.flight)
    gone_on = dry_run(
        encode_trajectory(later, space=limits.space), later, limits.airframe, limits.flight, snapshot=believed
    )
    rows = slice(begin * 10, begin * 10 + 2000)
    np.testing.assert_allclose(gone_on.loop.position[:2000], at_once.loop.position[rows], atol=1e-5)


def test_new_waypoints_replace_those_ahead(held, limits):
    made = replan(held, NOW + 5, [[-0.5, 0.8, 1.0], [0.5, 2.0, 1.0]], limits)
    new = after(held, limits, made)
    assert new.commitment.splices == (NOW + 5 + made.equal,)
    end = decode(new.commitment.payloads[-1:])
    np.testing.assert_allclose(end.position, [[0.5, 2.0, 1.0]], atol=5.1e-4)


def test_more_waypoints_follow_those_ahead_without_a_stop(held, limits):
    more = [-0.8, 2.4, 0.9]
    new = after(held, limits, replan(held, NOW + 5, [more], limits, keep=True))
    np.testing.assert_allclose(new.ahead[-2:], [WAYPOINTS[-1], more])
    flown = new.flown.at(np.arange(0.0, new.flown.duration, 0.01))
    for waypoint in WAYPOINTS[1:]:  # still flown through
        assert np.linalg.norm(flown.position - waypoint, axis=1).min() < 0.02
    at_the_old_end = int(np.argmin(np.linalg.norm(flown.position - WAYPOINTS[-1], axis=1)))
    assert np.linalg.norm(flown.velocity[at_the_old_end]) > 0.5


def test_after_its_end_the_vehicle_starts_from_rest(held, limits):
    late = held.commitment.last + 300
    new = after(held, limits, replan(held, late, [[0.0, 0.5, 1.0]], limits), now=late - 5)
    state = decode(new.commitment.payloads)
    np.testing.assert_allclose(state.position[0], WAYPOINTS[-1], atol=5.1e-4)
    np.testing.assert_allclose(state.position[-1], [0.0, 0.5, 1.0], atol=5.1e-4)
    new = after(new, limits, replan(new, late + 60, [[0.5, -0.5, 1.0]], limits, keep=True), now=late + 55)
    np.testing.assert_allclose(new.flown.trajectories[-1].path(new.reached), new.ahead, atol=1e-9)


def test_where_link_loss_would_end_outside_the_vehicle_flies_slower(held, limits):
    """Straight at a wall, 25 cm before which the last waypoint lies."""
    wall = limits.space.high[1]
    leave = held.commitment.last + 100
    far = after(held, limits, replan(held, leave, [[0.0, -1.0, 1.0]], limits), now=leave - 5)
    again = far.commitment.last + 100
    slow = replan(far, again, [[0.0, wall - 0.25, 1.0]], limits)
    speeds = np.linalg.norm(decode(slow.proposal.payloads).velocity, axis=1)
    assert speeds.max() < 1.25
    after(far, limits, slow, now=again - 5)


def test_in_flight_it_slows_down_to_that(held, limits):
    """A lower speed from the joint on, reached gently, and without a jump at the joint."""
    leave = 1.2
    made = continue_plan(held.flown.trajectories[0], leave, [[-0.4, 1.0, 1.0], [0.4, 2.4, 1.0]], limits, speed=0.8)
    moments = np.arange(0.0, made.plan.trajectory.duration, 0.01)
    speeds = np.linalg.norm(made.plan.trajectory.at(moments).velocity, axis=1)
    before = float(np.linalg.norm(held.flown.at(leave).velocity))
    assert speeds[0] == pytest.approx(before, abs=1e-6)
    assert before > 1.0
    assert speeds[len(speeds) // 2 :].max() < 0.81


def test_a_flight_replanned_again_and_again_keeps_every_limit_in_what_was_sent(held, limits):
    """Random waypoints, some 0.4 s apart: the sequence that was sent is the encoding of one motion without a jump."""
    random = np.random.default_rng(4)
    now, sent, replanned, flown = 20, [held.commitment.payloads[:20]], 0, held.flown
    for _ in range(14):
        points = random.uniform([-1.0, -2.2, 0.8], [1.0, 2.2, 1.2], (3, 3))
        try:
            made = replan(held, now + 5, points, limits)
        except InfeasibleError:
            made = None
        if made is not None:
            held, replanned = after(held, limits, made, now), replanned + 1
            flown = flown.continued(made.joint, made.plan.trajectory)
            assert certify(made.plan.trajectory, limits.plan, limits.space).passed
        span = int(random.integers(25, 55))
        rows = np.minimum(np.arange(now, now + span), held.commitment.last) - held.commitment.first
        sent.append(held.commitment.payloads[rows])
        now += span
    assert replanned >= 8
    rows = np.arange(now, held.commitment.last + 1) - held.commitment.first
    sequence = np.concatenate([*sent, held.commitment.payloads[rows]])
    whole = encode_trajectory(flown, space=limits.space)
    check_bytes(whole, flown, limits.plan)
    assert len(sequence) == len(whole.payloads)
    np.testing.assert_allclose(decode(sequence).position, decode(whole.payloads).position, atol=1.001e-3)
    np.testing.assert_allclose(decode(sequence).velocity, decode(whole.payloads).velocity, atol=1.001e-3)
    assert dry_run(whole, flown, limits.airframe, limits.flight).passed
    assert len(held.flown.trajectories) < len(flown.trajectories)  # what is behind is forgotten


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
    hovering = at_pace(hold_hover((0.0, 0.0, 0.8), 0.0, limits), 1.0)
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
        made = go_on(held, first, limits, PART)
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


def test_what_is_simulated_meanwhile_is_what_is_simulated_at_once(held, limits):
    """To the byte, stops too; and the simulated vehicle at each setpoint."""
    at_once = replan(held, NOW + 5, FAR, limits, part=PART)
    meanwhile = replan(held, NOW + 5, FAR, limits, part=PART, attempt=AnswerAttempt(in_time, Ways(), meanwhile=True))
    assert meanwhile.held.simulated.coming is not None
    assert meanwhile.proposal.checksum == at_once.proposal.checksum
    np.testing.assert_array_equal(meanwhile.proposal.stops, at_once.proposal.stops)
    np.testing.assert_array_equal(meanwhile.held.snapshots, at_once.held.snapshots)
    assert meanwhile.held.simulated.coming.exception() is None


@pytest.mark.parametrize(
    "fails", ["link_loss_at_walls", "meet_gaps", "rehearse_setpoints", "assess_link_loss_of_stops"]
)
def test_on_what_does_not_pass_in_its_simulation_nothing_can_be_planned(held, limits, monkeypatch, fails):
    def ends_badly(*_, **__):
        raise EndsBadlyError("it ends outside", where="link loss")

    monkeypatch.setattr(certified_flight, fails, ends_badly)
    attempt = AnswerAttempt(in_time, Ways(), meanwhile=True)
    made = replan(held, NOW + 5, FAR, limits, part=PART, attempt=attempt)
    on_that = accepted(made, spliced(held.commitment, made.proposal, NOW))
    assert isinstance(made.held.simulated.coming.exception(), EndsBadlyError)
    with pytest.raises(UnfoundedError):
        replan(on_that, NOW + 10, FAR[::-1], limits, part=PART, attempt=attempt)
    with pytest.raises(UnfoundedError):
        halt(on_that, NOW + 10, limits)


def test_each_part_ends_at_rest_inside_and_its_beginning_is_the_plan(held, limits):
    parts, last = in_parts(held, limits)
    plan_bytes = encode_trajectory(last.flown, gains=gains_under(limits), space=limits.space).payloads
    for made in parts[:-1]:
        proposal, stops_from = made.proposal, made.held.stops_from
        assert stops_from == proposal.splice - made.equal + PART
        before_stop = stops_from - proposal.splice
        np.testing.assert_array_equal(proposal.payloads[:before_stop], plan_bytes[proposal.splice : stops_from])
        np.testing.assert_array_equal(proposal.stops[before_stop], proposal.payloads[before_stop : before_stop + 121])
        worst = link_loss_at_every_setpoint(
            proposal.payloads, limits, starts=snapshots_at(made.held, proposal.splice)
        ).worst
        assert worst.beyond <= 0.0


def test_a_proposal_leaves_out_what_is_committed_to_the_byte_and_its_first_setpoint_is(held, limits):
    """Packets round what looking ahead changes at first. So the pilot has more time until the first that is another."""
    left_out = []
    for begin in range(NOW, NOW + 60, 10):
        made = replan(held, begin, [[-0.5, 0.8, 1.0], [0.5, 2.0, 1.0]], limits)
        proposal, committed = made.proposal, held.commitment.payloads
        assert proposal.splice == begin + made.equal
        np.testing.assert_array_equal(proposal.payloads[0], committed[proposal.splice])
        assert (proposal.payloads[1] != committed[proposal.splice + 1]).any()
        whole = encode_trajectory(made.held.flown, gains=gains_under(limits), space=limits.space).payloads
        np.testing.assert_array_equal(whole[begin : begin + made.equal], committed[begin : begin + made.equal])
        np.testing.assert_array_equal(proposal.payloads, whole[proposal.splice :])
        left_out.append(made.equal)
    assert max(left_out) > 0


def test_a_plan_that_changes_the_motion_late_begins_at_another_joint_if_that_is_sooner(held, limits):
    """But in time, and with a committed setpoint as every proposal does."""
    sooner = []
    for waypoint in ([-1.2, 2.5, 1.0], [0.0, -3.0, 1.0], [-1.5, -1.0, 0.8]):
        for begin in range(NOW - 20, NOW + 120, 5):
            plain, made = (
                replan(held, begin, [waypoint], limits, part=PART, attempt=AnswerAttempt(in_time, Ways(), first))
                for first in (None, lambda begin=begin: begin + 1)
            )
            if plain.proposal.splice <= begin + 1 + CLOSE:
                assert made.proposal.checksum == plain.proposal.checksum
            else:
                assert begin + 1 <= made.proposal.splice <= plain.proposal.splice
            np.testing.assert_array_equal(made.proposal.payloads[0], held.commitment.payloads[made.proposal.splice])
            after(held, limits, made, now=begin - 5)
            sooner.append(plain.proposal.splice - made.proposal.splice)
    assert np.count_nonzero(sooner) >= 3


def test_a_plan_that_changes_the_motion_late_goes_another_way_if_that_is_sooner(held, limits):
    """A way of another kind, that takes hardly longer; the next try of the same request takes that first."""
    others = 0
    for waypoint in ([-1.2, 2.5, 1.0], [0.0, -3.0, 1.0], [-1.5, -1.0, 0.8]):
        for begin in range(NOW - 20, NOW + 120, 5):
            plain, attempt = Ways(), AnswerAttempt(in_time, Ways(), lambda begin=begin: begin + 1)
            one, made = (
                replan(held, begin, [waypoint], limits, part=PART, attempt=each)
                for each in (AnswerAttempt(in_time, plain), attempt)
            )
            if attempt.ways.found != plain.found:
                others += 1
                assert attempt.ways.found[0] > plain.found[0]
                assert begin + 1 <= made.proposal.splice < one.proposal.splice
                assert made.held.ends <= one.held.ends + LOSES * one.plan.trajectory.duration
    assert others >= 2


def test_within_a_stop_no_other_joint_is_looked_for(held, limits):
    """From none of them the vehicle would turn off sooner than where it rests."""
    stopped, asked = after(held, limits, halt(held, NOW + 5, limits)), []

    def first_in_time():
        asked.append(NOW + 10)
        return asked[-1]

    attempt = AnswerAttempt(in_time, Ways(), first_in_time)
    made = replan(stopped, NOW + 10, [[-0.5, 0.8, 1.0]], limits, part=PART, attempt=attempt)
    assert made.proposal.splice > NOW + 10 + CLOSE
    assert not asked  # as it is before each other joint


def test_where_turning_off_at_once_would_end_badly_the_vehicle_first_flies_on_as_it_did(held, limits, monkeypatch):
    """At full speed, as on what it would fly anyway it ends well; and the next try of the request begins with that."""
    certify, tried = certified_flight.certify_beginning, []
    left = held.flown.at(np.arange(NOW / RATE, NOW / RATE + 0.5, 1e-6)).position  # 2 µm apart

    def ends_badly_if_it_turns_off(flown, *given, **options):
        there = flown.at(flown.starts[-1] + 0.095).position
        tried.append(np.linalg.norm(left - there, axis=1).min())
        if tried[-1] > 2e-6:
            raise EndsBadlyError("it ends outside", where="link loss")
        return certify(flown, *given, **options)

    monkeypatch.setattr(replanning, "certify_beginning", ends_badly_if_it_turns_off)
    attempt = AnswerAttempt(in_time, Ways())
    for tries in (2, 3):
        made = replan(held, NOW, FAR, limits, part=PART, attempt=attempt)
        assert len(tried) == tries
        assert fastest_after(made) > 1.5


def test_a_plan_that_would_end_badly_and_is_late_is_made_otherwise_at_once_the_next_time(held, limits, monkeypatch):
    """By then it is too late to fly it otherwise from the same joint, and as it was it would end badly again."""
    certify, tried, late = replanning.certify_whole, [], True

    def ends_badly_if_fast(flown, limits, starts):
        tried.append(max(np.linalg.norm(flown.at(np.arange(1.5, flown.duration, 0.05)).velocity, axis=1)))
        if tried[-1] > 1.5:
            raise EndsBadlyError("it ends outside", where="link loss")
        return certify(flown, limits, starts)

    monkeypatch.setattr(replanning, "certify_whole", ends_badly_if_fast)
    attempt = AnswerAttempt(lambda splice, equal: late and bool(tried), Ways())
    far = [[-0.5, 0.9, 1.0], [0.4, 2.0, 1.0], [-0.8, -1.8, 1.0]]
    with pytest.raises(TooLateError):
        replan(held, NOW, far, limits, attempt=attempt)
    late = False
    made = replan(held, NOW + 10, far, limits, attempt=attempt)
    assert len(tried) == 3
    assert tried[1] > 1.5 > tried[2]
    assert made.plan is not None


FAST = 1.3  # m/s, faster than which link loss far ahead is foreseen to end outside in the next two tests


def in_time(splice, equal):
    return False


@pytest.fixture
def foreseen(monkeypatch):
    """Return the highest speed, m/s, of each flight that was looked at from 2 s on."""
    speeds = []

    def foresee(payloads, limits, starts):
        speeds.append(np.linalg.norm(decode(payloads).velocity, axis=1)[150:].max())
        if speeds[-1] > FAST:
            raise EndsBadlyError("it ends outside", where="link loss")

    for module in (certified_flight, replanning):
        monkeypatch.setattr(module, "foresee_link_loss", foresee)
    return speeds


def fastest_after(made, seconds=2.0):
    times = np.arange(seconds, made.plan.trajectory.duration, 0.02)
    return np.linalg.norm(made.plan.trajectory.at(times).velocity, axis=1).max()


@pytest.mark.parametrize("at_once", [True, False])
def test_what_would_end_badly_far_ahead_is_flown_slower_at_once_or_later(held, limits, foreseen, at_once):
    """The first part is certified in any case."""
    made = replan(held, NOW + 5, FAR, limits, part=PART, attempt=AnswerAttempt(in_time, Ways(), foresee=at_once))
    after(held, limits, made)
    assert bool(fastest_after(made) < FAST) is at_once
    assert len(foreseen) == (3 if at_once else 0)


def test_what_is_committed_is_flown_slower_before_it_would_end_badly(held, limits, foreseen):
    made = replan(held, NOW + 5, FAR, limits, part=PART, attempt=AnswerAttempt(in_time, Ways(), foresee=False))
    fast = after(held, limits, made)
    slower = slowed_ahead(fast, NOW + 20, limits, PART, AnswerAttempt(in_time, Ways()))
    assert slower.joint > made.joint
    assert fastest_after(slower) < FAST < fastest_after(made)
    slow = after(fast, limits, slower, NOW + 15)
    np.testing.assert_allclose(slow.ahead, FAR)
    assert len(foreseen) == 2
    assert slowed_ahead(slow, NOW + 30, limits, PART, AnswerAttempt(in_time, Ways())) is None
    assert slowed_ahead(held, NOW + 30, limits, PART, AnswerAttempt(in_time, Ways())) is None  # all of it is certified
    assert len(foreseen) == 3


def test_what_ends_badly_far_ahead_however_slowly_it_is_flown_is_refused(held, limits, monkeypatch):
    made = replan(held, NOW + 5, FAR, limits, part=PART, attempt=AnswerAttempt(in_time, Ways(), foresee=False))
    fast = after(held, limits, made)

    def foresee(*_):
        raise EndsBadlyError("it ends outside", where="link loss")

    for module in (certified_flight, replanning):
        monkeypatch.setattr(module, "foresee_link_loss", foresee)
    with pytest.raises(EndsBadlyError):
        slowed_ahead(fast, NOW + 20, limits, PART, AnswerAttempt(in_time, Ways()))


def test_where_the_next_part_would_end_badly_the_vehicle_slows_down_before_it(held, limits, monkeypatch):
    made = replan(held, NOW + 5, FAR, limits, part=PART)
    fast = after(held, limits, made)

    def certify(flown, *given, **options):
        if flown.trajectories[-1] is made.plan.trajectory:
            raise EndsBadlyError("it ends outside", where="link loss")
        return certified_flight.certify_beginning(flown, *given, **options)

    monkeypatch.setattr(replanning, "certify_beginning", certify)
    slower = go_on(fast, NOW + 20, limits, PART)
    assert slower.joint < fast.stops_from / RATE
    assert fastest_after(slower) < fastest_after(made)
    np.testing.assert_allclose(after(fast, limits, slower, NOW + 15).ahead, FAR)


def test_a_part_that_comes_too_late_goes_on_from_rest(held, limits):
    made = replan(held, NOW + 5, FAR, limits, part=PART)
    first = after(held, limits, made)
    late = first.stops_from + 30
    made = go_on(first, late, limits, PART)
    assert made.proposal.splice - made.equal == first.stops_from + 120 + LOOKS_BACK  # where it rests
    after(first, limits, made, late - 5)
    np.testing.assert_allclose(made.held.ahead, FAR)
    np.testing.assert_allclose(made.plan.path(0.0), first.rest[0])


def test_more_waypoints_asked_for_while_a_plan_is_committed_in_parts_follow_all_of_it(held, limits):
    first = after(held, limits, replan(held, NOW + 5, FAR, limits, part=PART))
    made = replan(first, NOW + 40, [[-0.5, -2.0, 1.0]], limits, keep=True, part=PART)
    np.testing.assert_allclose(made.held.ahead, [*FAR, [-0.5, -2.0, 1.0]])
    after(first, limits, made, NOW + 35)


def test_a_stop_on_a_plan_in_parts_is_a_stop_and_nothing_follows_it(held, limits):
    first = after(held, limits, replan(held, NOW + 5, FAR, limits, part=PART))
    stopped = after(first, limits, halt(first, NOW + 40, limits), NOW + 35)
    assert not stopped.unfinished
    assert not given_up(first, limits).unfinished


def test_after_a_stop_beside_a_wall_a_plan_begins_with_what_is_committed(limits):
    """There a hover leans, so its bytes tell its yaw too coarsely; every plan after such a stop was refused once."""
    wall = np.array(limits.space.high)[0]
    points = np.array([[wall - 0.5, -2.0, 0.9], [wall - 0.45, 2.2, 1.2]])
    flown = plan(
        min_snap(points, times=centripetal_times(points)), limits.airframe, limits, planner="expert", yaw_angle=0.6
    )
    held = hold(flown, points)
    stopped = after(held, limits, halt(held, NOW + 5, limits))
    rests = stopped.exact_from + 5
    after(stopped, limits, replan(stopped, rests, [[0.0, 0.5, 1.0]], limits), rests - 5)
    in_part = after(held, limits, replan(held, NOW + 5, [[wall - 0.45, 2.0, 1.2]], limits, part=20))
    resting = at_rest_from(in_part, in_part.stops_from + 5, limits)
    first = resting.exact_from + 5
    after(resting, limits, replan(resting, first, [[0.0, 0.5, 1.0]], limits), first - 5)


@pytest.fixture(scope="module")
def interrupted(held, limits):
    """A plan in parts, the third of which did not pass: the vehicle is to stop behind two, and to go on from there."""
    begun = after(held, limits, replan(held, NOW + 5, FAR, limits, part=PART))
    begun = after(begun, limits, go_on(begun, NOW + 20, limits, PART), NOW + 10)
    return after_failure(begun, limits)


def test_where_a_part_does_not_pass_the_vehicle_stops_before_it_and_goes_on_from_there(interrupted, limits):
    assert interrupted.unfinished
    made = go_on(interrupted, NOW + 30, limits, PART)
    assert made.proposal.splice - made.equal == interrupted.exact_from  # long before the vehicle comes there
    assert made.plan is not None
    later = after(interrupted, limits, made, NOW + 25)
    np.testing.assert_allclose(later.ahead[-1], FAR[-1])
    assert not np.linalg.norm(decode(made.proposal.payloads[:5]).velocity, axis=1).any()
    again = after_failure(interrupted, limits)
    assert not again.unfinished  # once it rests, there is nothing else to try


@pytest.mark.parametrize("planned", [False, True], ids=["before that is planned", "once that is planned"])
def test_other_waypoints_are_flown_at_once_before_such_a_stop(interrupted, limits, planned):
    held = interrupted
    if planned:
        held = after(held, limits, go_on(held, NOW + 30, limits, PART), NOW + 25)
    first = NOW + 40
    made = replan(held, first, [[-0.8, 0.6, 1.1], [0.5, 1.8, 1.0]], limits, part=PART)
    assert made.proposal.splice - made.equal < first + 36
    new = after(held, limits, made, first - 5)
    encoded = encode_trajectory(new.flown.since(first / RATE), gains=gains_under(limits), space=limits.space)
    rows = slice(first - new.commitment.first, made.proposal.splice - made.equal + PART - new.commitment.first)
    np.testing.assert_array_equal(new.commitment.payloads[rows], encoded.payloads[: rows.stop - rows.start])


@pytest.mark.parametrize("planned", [False, True], ids=["before that is planned", "once that is planned"])
def test_a_stop_is_as_soon_before_such_a_stop_and_nothing_follows_it(interrupted, limits, planned):
    held = interrupted
    if planned:
        held = after(held, limits, go_on(held, NOW + 30, limits, PART), NOW + 25)
    made = halt(held, NOW + 40, limits)
    assert made.proposal.splice == NOW + 40
    assert made.held.exact_from < interrupted.exact_from - 50
    stopped = after(held, limits, made, NOW + 35)
    assert not stopped.unfinished
    assert stopped.commitment.motion_ends < NOW + 40 + 121


def test_within_a_stop_nothing_is_left_until_it_rests(interrupted, limits):
    within = interrupted.exact_from - 60
    made = replan(interrupted, within, [[0.0, 0.5, 1.0]], limits)
    assert made.proposal.splice - made.equal == interrupted.exact_from


def test_where_no_way_leads_on_from_the_motion_one_leads_on_from_rest_behind_a_stop(held, limits):
    first = NOW + 5
    behind = held.flown.at(first / RATE).position - 0.15 * held.flown.at(first / RATE).velocity
    made = replan_behind_stop(held, first, [behind], limits, part=PART)
    assert made.stop is not None
    assert made.stop.proposal.splice == first
    stopped = after(held, limits, made.stop)
    new = after(stopped, limits, following(made, stopped.commitment))
    assert new.commitment.splices == (first, stopped.exact_from)
    end = decode(new.commitment.payloads[-1:]).position[0]
    np.testing.assert_allclose(end, behind, atol=1e-3)
    still = stopped.exact_from - new.commitment.first
    assert not decode(new.commitment.payloads[still : still + 5]).velocity.any()


def test_waypoints_that_follow_a_plan_from_rest_may_be_asked_for_long_before_it_begins(held, limits):
    """At the moment itself at which it begins to move no way leads on from the motion; a little later one does."""
    back = held.flown.at((NOW + 5) / RATE).position - 0.15 * held.flown.at((NOW + 5) / RATE).velocity
    made = replan_behind_stop(held, NOW + 5, [back, [0.6, 0.2, 1.0]], limits)
    stopped = after(held, limits, made.stop)
    turned = after(stopped, limits, following(made, stopped.commitment))
    more = replan(turned, NOW + 20, [[-0.6, 1.5, 1.1]], limits, keep=True)
    assert more.joint > turned.flown.starts[-1] > (NOW + 60) / RATE
    new = after(turned, limits, more, NOW + 15)
    np.testing.assert_allclose(new.ahead, [back, [0.6, 0.2, 1.0], [-0.6, 1.5, 1.1]])


def test_a_stop_that_is_asked_for_adds_little_to_how_far_the_vehicle_strays(limits):
    """Over the top of a climb motors come to their ends: what strays a little in the dry run strays much in flight.

    With the longest motor lag it strays much in the dry run, too.
    """
    points = np.array([[-1.0, -2.0, 0.6], [0.0, -0.6, 1.5], [0.2, 1.0, 0.7], [-0.5, 2.0, 1.0]])
    path = min_snap(points, times=centripetal_times(points))
    held = hold(plan(path, limits.airframe, limits, planner="expert"), points)
    sluggish = replace(limits.airframe, motor_time_constant=max(limits.link_loss.motor_lags))
    for begins in (*range(100, 200, 12), 144, 164, 180, 192):
        stop, starts = halt(held, begins, limits), snapshots_at(held, begins)
        as_one_believes = limits.airframe, as_believed(starts, limits), 0.026
        for airframe, start, most in (as_one_believes, (sluggish, starts[-1], 0.161)):
            run = rehearse_setpoints(stop.proposal.payloads, airframe, limits.flight, snapshot=start)
            assert run.passed
            before = np.linalg.norm(start[:3] - held.flown.at(begins / RATE).position)
            assert run.deviation < before + most, (begins, airframe.motor_time_constant)
