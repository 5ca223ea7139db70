"""Replanning: from what is committed and a request to a proposal that is certified like any plan, for the pilot.

A held flight is what the planner knows of what the pilot is bound to fly: the trajectories behind the bytes, and the
simulated vehicle at each setpoint. So what is checked of a new plan is checked of the whole flight: bytes, stops, link
loss, gaps and the dry run go on from the splice as if the flight had been planned so from its beginning.

A plan may be committed in parts, so that the motion changes soon: its beginning and the stop behind that, and then, by
go_on(), one part after another before the vehicle comes to the stop. A planner that fails meanwhile leaves it to that.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import CfplanError, InfeasibleError, InputError, NotCertifiedError
from cfplan.flight.setpoints.commitment import SPLICE_AHEAD, Commitment, Proposal, propose
from cfplan.flight.setpoints.encoding import HOLD, LEAD, RATE, RATE_LEAD, EncodedFlight, encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stop_certificate import certify_stops
from cfplan.flight.setpoints.stops import DURATION, encode_stops, rest_behind
from cfplan.flight.telemetry import Triple
from cfplan.geometry.min_snap import MIN_SPACING, centripetal_times, spaced
from cfplan.numbers import coordinates
from cfplan.planning.continuation import (
    KINDS,
    LATE_HINT,
    ON_PATH_LEFT,
    NoWayError,
    TooLateError,
    Ways,
    check_waypoints,
    continue_plan,
    path_from_rest,
)
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan
from cfplan.preparation.certified_flight import (
    STOP,
    CertifiedFlight,
    EndsBadlyError,
    Simulated,
    certify_beginning,
    certify_meanwhile,
    certify_whole,
    encoded_for,
    foresee_link_loss,
    meet_gaps,
    require_inside,
)
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside
from cfplan.simulation.dry_run import Rehearsal, rehearse_setpoints
from cfplan.simulation.link_loss import as_believed, as_most_sluggish, link_loss_at_walls
from cfplan.vehicle.hover import hover_at
from cfplan.vehicle.joint import JoinedTrajectory

SLOWER = (1.2, 0.7)  # m/s, at which a flight is tried that would end badly at full speed
# Setpoints by which the vehicle may fly on before it turns off, where it cannot do so at once. Where waypoints ahead
# stay, a little later only ways lead on that lose more time than waiting does.
LATER, LATER_KEEPING = (0, 3, 5, 8, 15, 35), (0, 15, 35)
NEARBY = 5  # setpoints of that, within which the ways that are known count
CLOSE = 1  # setpoint by which a plan may change the motion later than it might, without others being tried
OTHERS = 6  # plans that are tried at most to change it sooner
NEARBY_FIRST = (-2, -3, -1, 0, 1, 2, 3)  # joints that are tried, in setpoints from the first that is in time
LOSES = 0.005  # share of its time that a plan may take longer, if it changes the motion sooner
SOON = 3  # setpoints by which the vehicle slows down later than the next part needs, which was planned in vain by then
LEAST_SPEED = 0.2  # m/s, to which requests may lower the speed
PACE = 0.75  # by which a request lowers the speed; one to raise it undoes that
LOOKS_BACK = math.ceil(RATE_LEAD * RATE)  # setpoints before one, of whose motion it is made too
HOVER = 0.05  # s, of the motion that a hover counts as
_SNAPSHOTS_KEPT = 6000  # setpoints before a splice, of which snapshots are kept: no plan leaves before these
STOPS = (0.46, 0.48, 0.5, 0.52, 0.54, 0.55, 0.56, 0.58, 0.6, 0.65, 0.7, 0.8, 1.0, DURATION)
"""s within which a request to stop is tried to be met. From 2 m/s straight on 0.54 s brake at 6.9 m/s², a tilt of 35°;
where the vehicle turns or slows down already it is more or less. One that holds its deceleration is planned to rest
0.1 m sooner, but motors that lag let the vehicle overshoot that by as much."""
STRAYS = 0.025  # m, that a stop shorter than others may add to how far the vehicle strays in its dry run
"""Where it adds as much, motors are at their ends, and a little noise makes it more: of two stops that strayed by 2.8
and 4.0 cm in the dry run, the flights strayed by 8.9 and 6.1 cm."""
STRAYS_SLUGGISH = 0.16  # m, likewise with the longest motor lag
"""That shows it more clearly. Of 440 stops the two that strayed farthest in flight, by 8.3 and 4.6 cm, did so by 0.24
and 0.22 m in this dry run; the 437 that did so by less than 0.16 m strayed by 4.0 cm at most in flight."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldFlight:
    """What is committed, and what it was made from; its clock is 0 at setpoint 0."""

    commitment: Commitment
    flown: JoinedTrajectory
    ahead: NDArray  # (K, 3) m, waypoints of the last plan, in order
    reached: tuple[float, ...]  # s on the last plan's path, of each of them
    begin: int  # number of the setpoint of the first snapshot
    simulated: Simulated  # at each setpoint
    speed: float = math.inf  # m/s, at which new plans fly at most, as was asked for; the limits' counts besides
    exact_from: int = 0
    """Number of the setpoint from which on the trajectories are those behind the bytes: in a stop before it they are
    those that it brakes along."""
    stops_from: int | None = None
    """Number of the first setpoint of the stop behind the part of the plan that is committed; None where all of it is.
    The trajectories are those of the whole plan."""
    rest: tuple[Triple, float] | None = None  # m, rad: place and yaw where that stop rests
    left: NDArray = field(default_factory=lambda: np.empty((0, 3)))
    """(J, 3) m, waypoints of a plan that was stopped before them, as its next part did not pass, or came too late."""
    halts: tuple[tuple[int, int], ...] = ()
    """Of each stop on the way, the setpoints from which on and before which the trajectories are not those behind the
    bytes."""

    @property
    def snapshots(self) -> NDArray:
        """Return (L, N, 31), the simulated vehicle at each setpoint, as Simulated.snapshots."""
        return self.simulated.snapshots

    @property
    def ends(self) -> float:
        """Return when the motion ends, s, once all of the plan is committed."""
        return self.flown.duration

    @property
    def unfinished(self) -> bool:
        """Return whether there is more of the plan than is committed."""
        return self.stops_from is not None or len(self.left) > 0


@dataclass(frozen=True, slots=True, eq=False)
class Replanned:
    """A proposal, what will be held once the pilot has accepted it, and the plan behind it."""

    proposal: Proposal
    held: HeldFlight
    plan: Plan | None  # None for a stop, which brakes along the plan before
    joint: float  # s from setpoint 0, from when on the motion is another
    stop: "Replanned | None" = None  # to be proposed before it, where it begins from the rest behind that
    equal: int = 0  # setpoints by which the proposal begins later than it might, as so many are the committed ones


class Manner(NamedTuple):
    """How a plan is flown."""

    speed: float  # m/s, at most
    kinds: Sequence[int] = KINDS  # of path


@dataclass(frozen=True, slots=True)
class AnswerAttempt:
    """One try to answer a request; another is made where it comes too late, with the ways that are known by then."""

    too_late: Callable[[int, int | None], bool]
    """Whether a plan from a setpoint on, not certified yet, will come too late for it: so many setpoints stay as they
    are committed, None where that is not known."""
    ways: Ways
    in_time: Callable[[], int] | None = None
    """Number of the first setpoint that is in time for a plan that is made and must be checked. With it, other joints
    are tried while a plan would change the motion later than that."""
    foresee: bool = True  # whether link loss far ahead counts at once; else it is for slowed_ahead() to look at that
    meanwhile: bool = False
    """Whether what is simulated of a plan's beginning goes on beside when it is returned. Before it is proposed, that
    must have passed; what is planned on it by then raises UnfoundedError where it has not. Link loss far ahead does not
    count then."""
    bad: set[Manner] = field(default_factory=set)  # in which it would end badly; written as they are tried


def hold(planned: Plan, waypoints: ArrayLike) -> HeldFlight:
    """Return what is held of a plan that begins at rest, through waypoints (K, 3) m with centripetal times.

    The first waypoint is its start. Raises InfeasibleError or NotCertifiedError where it does not pass what replan()
    asks of plans.
    """
    points = np.asarray(waypoints, dtype=float)
    flown = JoinedTrajectory((planned.trajectory,), (0.0,))
    made = certify_whole(flown, planned.limits, None)
    reached = tuple(np.cumsum(centripetal_times(points)).tolist())
    return HeldFlight(Commitment(0, made.payloads, made.stops), flown, points[1:], reached, 0, made.simulated)


def hold_hover(position: Triple, yaw: float, limits: Limits) -> HeldFlight:
    """Return what is held of a vehicle that hovers at a position, m, with a yaw, rad, until it is asked to fly.

    Raises InfeasibleError where that lies outside the space, or link loss there would end outside the walls.
    """
    (beyond,), (face,) = limits.space.nearest(np.array([position]))
    if not inside(beyond):
        raise InfeasibleError(
            f"the hover at {coordinates(position, '.2f')} m is {beyond:.2f} m too {limits.space.too(face)}",
            where="take-off",
            hint="take off to a height inside the space less its margin, and nearer to the middle of the room",
        )
    flown = JoinedTrajectory((hover_at(position, yaw, HOVER, limits.airframe),), (0.0,))
    made = certify_whole(flown, limits, None)
    place = np.array([position], dtype=float)
    return HeldFlight(Commitment(0, made.payloads, made.stops), flown, place, (HOVER,), 0, made.simulated)


def replan(
    held: HeldFlight,
    splice: int,
    waypoints: ArrayLike,
    limits: Limits,
    *,
    keep: bool = False,
    yaw_angle: float = 0.0,
    part: int | None = None,
    attempt: AnswerAttempt | None = None,
) -> Replanned:
    """Return the proposal to leave what is held at setpoint `splice` and to go through waypoints, (K, 3) m, to rest.

    The motion changes SPLICE_AHEAD setpoints after the splice, or a little later where it cannot do so at once. With
    `keep`, the waypoints follow those that are ahead, and the motion changes only once that to them has begun; else
    they replace them. Waypoints closer than MIN_SPACING to the one before, or to where the plan begins, are left out.
    Where the vehicle rests by then, the plan begins from rest. Where link loss or a gap would end badly, the vehicle
    flies slower. So many setpoints are proposed as `part` says, and the stop behind them; without it, all.

    Raises:
        InputError: what is given are no waypoints.
        InfeasibleError: no plan leads through them from there, or link loss would end outside the walls.
        NotCertifiedError: the plan, its bytes, a stop, a gap or the dry run does not pass.
        TooLateError: as the `attempt` says, where there is one.
    """
    points = np.asarray(waypoints, dtype=float)
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
        raise InputError(f"waypoints of shape {points.shape}", where="waypoints", hint="give rows of x, y, z in metres")
    check_waypoints(points, limits)
    return _replan_within(held, splice, _Wanted(points, limits, keep, yaw_angle, part, attempt))


def bound_already(
    held: HeldFlight, splice: int, waypoints: ArrayLike, limits: Limits, *, keep: bool = False
) -> HeldFlight | None:
    """Return the held flight if by it the vehicle already flies this request to replan(), or rests there; else None."""
    points = np.asarray(waypoints, dtype=float).reshape(-1, 3)
    if not len(points):  # nothing was asked for
        return None
    resting = at_rest_from(held, splice, limits)
    splice, _ = _leaving(resting, splice, keep)
    joint = (splice + SPLICE_AHEAD) / RATE
    here, last = resting.flown.at(joint).position, resting.flown.at(resting.ends).position
    s = float(resting.flown.trajectories[-1].s_at(max(joint - resting.flown.starts[-1], 0.0)))
    unreached = resting.ahead[np.array(resting.reached) > s]
    ahead = spaced(np.concatenate([here[None], unreached, last[None], resting.left]))
    if keep:
        return held if len(spaced(np.concatenate([ahead[-1:], points]))) == 1 else None
    wanted = spaced(np.concatenate([here[None], points]))
    if wanted.shape == ahead.shape and (np.linalg.norm(wanted - ahead, axis=1) < MIN_SPACING).all():
        return held
    return given_up(resting, limits) if len(wanted) == 1 and joint >= resting.ends else None


def pace(
    held: HeldFlight,
    splice: int,
    speed: float,
    limits: Limits,
    *,
    yaw_angle: float = 0.0,
    part: int | None = None,
    attempt: AnswerAttempt | None = None,
) -> Replanned | None:
    """Return the proposal to fly what is ahead at setpoint `splice` at a speed, m/s, at most; None where it rests.

    Then nothing need be proposed: what is asked for later flies so. See at_pace(). Raises as replan() does.
    """
    nothing_ahead = held.exact_from > 0 and not len(held.left)  # but to come to rest
    if nothing_ahead or (splice + SPLICE_AHEAD) / RATE >= held.ends:
        return None
    return _replan_within(at_pace(held, speed), splice, _nothing_new(limits, yaw_angle, part, attempt))


def go_on(
    held: HeldFlight, splice: int, limits: Limits, part: int, *, yaw_angle: float = 0.0
) -> Replanned | HeldFlight:
    """Return the proposal of the next part of a plan that is committed in parts, for one who plans from `splice` on.

    Where that would end badly, the vehicle flies slower, from soon on if that helps, else from the part on. Where it
    stops by then, as this comes too late, it goes on from rest; where it rests there as all was flown, that is held and
    nothing need be proposed. Raises as replan() does; then it rests behind the last part.
    """
    held = at_rest_from(held, splice, limits)
    if not held.unfinished:
        return held
    if held.stops_from is not None:
        ahead = held.stops_from - 1  # what is before that is committed already
        since, starts = held.flown.since(ahead / RATE), snapshots_at(held, ahead)
        with suppress(EndsBadlyError, NotCertifiedError):
            following = certify_beginning(since, part, limits, starts, foresee=False)
            return _proposed(held, ahead, following, None, math.nan)
        with suppress(InfeasibleError, NotCertifiedError):  # the sooner it slows down the better
            soon, slower = min(splice + SOON, ahead), _slower(held, limits)
            return _replan_within(held, soon, _nothing_new(limits, yaw_angle, part, slower))
        splice = ahead
    return _replan_within(held, splice, _nothing_new(limits, yaw_angle, part))


def _slower(held: HeldFlight, limits: Limits) -> AnswerAttempt:
    """Return the attempt that leaves out the speed at which the plan is flown."""
    return AnswerAttempt(lambda splice, equal: False, Ways(), bad={Manner(min(held.speed, limits.plan.speed))})


def slowed_ahead(
    held: HeldFlight, splice: int, limits: Limits, part: int, attempt: AnswerAttempt, *, yaw_angle: float = 0.0
) -> Replanned | None:
    """Return the proposal to fly slower from setpoint `splice` on, where link loss is foreseen to end badly far ahead.

    None where it is not, where it is flown as slowly as may be, and where all of the plan is committed by then, as all
    of that is certified. Raises as replan() does; then no slower plan passes either.
    """
    fastest = min(held.speed, limits.plan.speed)
    if held.stops_from is None or splice >= held.stops_from or limits.link_loss.only_warn or fastest <= SLOWER[-1]:
        return None
    ahead = held.stops_from - 1  # what is before that is certified
    encoded = _encoded_from(held.flown, ahead, limits)
    try:
        foresee_link_loss(encoded.payloads, limits, snapshots_at(held, ahead))
    except EndsBadlyError:
        attempt.bad.add(Manner(fastest))
        return _replan_within(held, splice, _nothing_new(limits, yaw_angle, part, attempt))
    return None


def given_up(held: HeldFlight, limits: Limits) -> HeldFlight:
    """Return what is held where there is to be no more of a plan than is committed."""
    if held.stops_from is None:
        return replace(held, left=np.empty((0, 3)))
    assert held.rest is not None
    return _resting(held, held.rest, held.stops_from, held.stops_from + STOP, limits)


def after_failure(held: HeldFlight, limits: Limits) -> HeldFlight:
    """Return what is held where the next part of a plan does not pass: it goes on from the rest behind the last one.

    Where that is what does not pass, there is to be no more.
    """
    return given_up(held, limits) if held.stops_from is None else interrupted(held, limits)


def at_rest_from(held: HeldFlight, splice: int, limits: Limits) -> HeldFlight:
    """Return what is held for one who plans from setpoint `splice` on.

    Where all that is committed until then is a part of a plan, the vehicle stops behind that: what is flown of the
    plan is that stop, and the waypoints behind it are left.
    """
    return held if held.stops_from is None or splice < held.stops_from else interrupted(held, limits)


def interrupted(held: HeldFlight, limits: Limits) -> HeldFlight:
    """Return what is held where the vehicle rests behind the part of a plan that is committed, and goes on from there.

    A plan that is committed whole goes on as it is.
    """
    if held.stops_from is None:
        return held
    rests_at = (held.stops_from + 0.5 * STOP) / RATE + LEAD - held.flown.starts[-1]  # on the clock of the plan
    left, _ = _still_ahead(held, rests_at, np.empty((0, 3)))
    return replace(given_up(held, limits), left=left)


def at_pace(held: HeldFlight, speed: float) -> HeldFlight:
    """Return the same flight, whose new plans fly at a speed, m/s, at most."""
    return replace(held, speed=max(speed, LEAST_SPEED))


class _Wanted(NamedTuple):
    """What is to be planned, see replan()."""

    points: NDArray  # (K, 3) m
    limits: Limits
    keep: bool
    yaw_angle: float  # rad
    part: int | None  # setpoints
    attempt: AnswerAttempt | None


def _nothing_new(limits: Limits, yaw_angle: float, part: int | None, attempt: AnswerAttempt | None = None) -> _Wanted:
    """Return that the waypoints ahead are to be planned anew, and no others."""
    return _Wanted(np.empty((0, 3)), limits, True, yaw_angle, part, attempt)


def _replan_within(held: HeldFlight, splice: int, wanted: _Wanted) -> Replanned:
    """Return what replan() does, at the speed that is asked for, or slower where it must be."""
    limits, attempt = wanted.limits, wanted.attempt
    splice, _ = _leaving(at_rest_from(held, splice, limits), splice, wanted.keep)  # from there on it may be later
    refused: InfeasibleError | None = None
    turns_off = not wanted.keep and (splice + SPLICE_AHEAD) / RATE < held.ends
    *manners, slowest = _manners(held, limits, turns_off=turns_off)
    for manner in [one for one in manners if attempt is None or one not in attempt.bad] + [slowest]:
        everywhere = manner.kinds == KINDS  # else it is one more try from where the others end badly
        for later in LATER_KEEPING if wanted.keep else LATER if everywhere else LATER[:1]:
            if later and held.stops_from is not None and splice + later >= held.stops_from:
                break
            try:
                at_once = attempt if later <= NEARBY else None
                return _replan_at(manner, held, splice + later, wanted._replace(attempt=at_once))
            except EndsBadlyError as error:
                refused = error
                if at_once is not None:
                    at_once.bad.add(manner)
                    if at_once.too_late(splice, None) and manner != slowest:
                        raise TooLateError("it is to be flown otherwise", where="request", hint=LATE_HINT) from error
                break
            except NoWayError as error:
                refused = refused or error
                if (splice + later + SPLICE_AHEAD) / RATE > held.ends:
                    break
        else:
            if everywhere:  # nor does a way lead on more slowly
                break
    assert refused is not None
    raise refused


def _manners(held: HeldFlight, limits: Limits, *, turns_off: bool) -> list[Manner]:
    """Return how plans are tried, one after another where link loss or a gap would end badly.

    What is flown ends well: where the vehicle `turns_off` from that, a plan that goes on along it first mostly ends
    well too, and takes less time than a slower one.
    """
    fastest = min(held.speed, limits.plan.speed)
    along = [Manner(fastest, ON_PATH_LEFT)] if turns_off else []
    return [Manner(fastest), *along, *(Manner(slower) for slower in SLOWER if slower < fastest)]


def _replan_at(manner: Manner, held: HeldFlight, splice: int, wanted: _Wanted) -> Replanned:
    """Return what replan() does, in that manner."""
    attempt, limits, part = wanted.attempt, wanted.limits, wanted.part
    ways, speed = Ways() if attempt is None else attempt.ways, manner.speed
    ways.restrict_to(manner.kinds)

    def too_late(splice: int) -> bool:
        return attempt is not None and attempt.too_late(splice, None)

    made = _plan_at(speed, held, splice, wanted, ways, too_late)
    if attempt is not None and attempt.too_late(made.splice, made.equal):
        raise TooLateError("the plan was not made in time", where="request", hint=LATE_HINT)
    if attempt is not None and attempt.in_time is not None and ways.found is not None:
        made = _sooner(made, ways, partial(_plan_at, speed, held, wanted=wanted), attempt.in_time)
    since, starts = made.held.flown.since(made.splice / RATE), partial(snapshots_at, made.held, made.splice)
    if part is None:
        passed = certify_whole(since, limits, starts())
    elif attempt is not None and attempt.meanwhile:
        passed = certify_meanwhile(since, part, limits, starts, made.encoded)
    else:
        foresee = attempt is None or attempt.foresee
        passed = certify_beginning(since, part, limits, starts(), foresee=foresee, encoded=made.encoded)
    return _proposed(made.held, made.splice, passed, made.plan, made.joint)


class _Unchecked(NamedTuple):
    """A plan that leaves what is held, before its setpoints are certified."""

    held: HeldFlight  # with it
    splice: int
    joint: float  # s from setpoint 0
    plan: Plan
    encoded: EncodedFlight  # its first setpoints, from the splice on
    equal: int  # see _equal()


def _plan_at(
    speed: float,
    held: HeldFlight,
    splice: int,
    wanted: _Wanted,
    ways: Ways,
    too_late: Callable[[int], bool] = lambda splice: False,
) -> _Unchecked:
    """Return the plan that leaves what is held at a setpoint, or as soon as it can behind that."""
    points, limits, keep, yaw_angle = wanted.points, wanted.limits, wanted.keep, wanted.yaw_angle
    held = at_rest_from(held, splice, limits)
    splice, left = _leaving(held, splice, keep)
    joint = (splice + SPLICE_AHEAD) / RATE
    leave, trajectory = joint - held.flown.starts[left], held.flown.trajectories[left]
    if leave >= trajectory.duration:
        place = held.flown.at(joint)
        points = spaced(np.concatenate([place.position[None], *([held.left] if keep else []), points]))
        if len(points) < 2:
            raise InfeasibleError("the vehicle rests there already", where="request", hint="nothing need be flown")
        path, reached = path_from_rest(points, limits)
        planned = plan(
            path,
            limits.airframe,
            limits,
            planner="expert",
            yaw_angle=float(place.yaw),
            speed_factor=min(speed / limits.plan.speed, 1.0),
        )
        points = points[1:]
    else:
        times = None
        if keep:
            points, times = _still_ahead(held, leave, points)
            if not len(points):
                raise InfeasibleError(
                    "the last waypoint is all but reached",
                    where="request",
                    hint="ask for waypoints instead; they are flown so",
                )
        else:
            state = trajectory.at(leave)
            points = spaced(np.concatenate([state.position[None], points]))[1:]
            if not len(points):
                raise NoWayError(
                    f"the vehicle passes it at {float(np.linalg.norm(state.velocity)):.2f} m/s",
                    where="waypoint 1",
                    hint="stop first, then ask for it again",
                )
        made = continue_plan(
            trajectory, leave, points, limits, times=times, yaw_angle=yaw_angle, speed=speed, ways=ways,
            too_late=lambda: too_late(splice),
        )  # fmt: skip
        planned, reached = made.plan, made.reached
    flown = held.flown.continued(joint, planned.trajectory)
    count = SPLICE_AHEAD if wanted.part is None else encoded_for(wanted.part)
    encoded = _encoded_from(flown, splice, limits, count)
    equal = _equal(held.commitment, splice, encoded.payloads)
    later = replace(held, flown=flown, ahead=points, reached=reached)
    return _Unchecked(later, splice, joint, planned, encoded, equal)


def _sooner(best: _Unchecked, ways: Ways, planned: Callable[..., _Unchecked], in_time: Callable[[], int]) -> _Unchecked:
    """Return a plan that changes the motion sooner than the best one so far and is in time, or that.

    On some ways the vehicle first flies as it would anyway, for longer than it takes to plan again. By how long the
    motion stays as it is, to the byte, differs from joint to joint and from way to way. So by turns the way found is
    tried from joints nearby, and other kinds of ways from the first joint in time. `planned` is _plan_at() of a splice.
    """
    assert ways.found is not None
    joints, kinds = {best.splice}, ways.kinds_behind(ways.found)
    ends = best.held.ends + LOSES * best.plan.trajectory.duration
    for number in range(OTHERS):
        first, change = in_time(), best.splice + best.equal
        if change <= first + CLOSE:
            break
        if number % 2 and kinds:
            splice, tried = first, Ways(failed=ways.failed, kinds=kinds)
        else:
            splice = next(first + off for off in NEARBY_FIRST if first + off not in joints)
            tried = Ways(ways.found, kinds=())
            joints.add(splice)
        if splice < best.held.begin:
            continue
        with suppress(CfplanError):  # no plan from there
            other = planned(splice=splice, ways=tried, too_late=lambda _, change=change: in_time() + CLOSE >= change)
            if other.splice > splice:  # sooner the vehicle cannot turn off
                break
            if in_time() <= other.splice + other.equal < change and other.held.ends <= ends:
                best, ways.found = other, tried.found
        if tried.kinds:
            kinds = () if tried.found is None else tried.kinds_behind(tried.found)
    return best


def _proposed(held: HeldFlight, splice: int, made: CertifiedFlight, planned: Plan | None, joint: float) -> Replanned:
    """Return the proposal of what was certified; `held` has the trajectories and waypoints behind it."""
    ending = 0 if made.following is None else len(made.payloads) - made.following - 1
    equal = 0 if planned is None else _equal(held.commitment, splice, made.payloads)
    payloads, stops = made.payloads[equal:], made.stops[equal:]
    proposal = propose(held.commitment, splice + equal, payloads, stops, ending, goes_on=planned is None)
    later = held_with(held, splice, made, since=held.commitment.first)
    return Replanned(proposal, later, planned, joint, equal=equal)


def _equal(commitment: Commitment, splice: int, payloads: NDArray) -> int:
    """Return how many setpoints from a splice on may be left out: the next one is the committed one to the byte, too.

    What is looked ahead changes setpoints by less than packets round for a while. So long, the pilot may send what it
    is bound to, and a proposal that leaves this out is in time for longer.
    """
    ahead = payloads[:SPLICE_AHEAD]
    rows = np.minimum(np.arange(splice, splice + len(ahead)), commitment.last) - commitment.first
    same = (commitment.payloads[rows] == ahead).all(axis=1)
    return max(int(np.argmin(same)) - 1, 0) if not same.all() else 0


def held_with(held: HeldFlight, splice: int, made: CertifiedFlight, since: int = 0) -> HeldFlight:
    """Return what is held once what was certified from setpoint `splice` on is committed.

    No plan leaves it before setpoint `since` any more.
    """
    rows = np.arange(min(max(splice - _SNAPSHOTS_KEPT, held.begin, since), splice), splice) - held.begin
    before = held.snapshots[:, np.minimum(rows, held.snapshots.shape[1] - 1)]  # behind the last the vehicle waits
    begin = splice - len(rows)
    return replace(
        held,
        begin=begin,
        flown=held.flown.kept_from(begin / RATE),
        simulated=made.simulated.behind(before),
        exact_from=0,
        stops_from=None if made.following is None else splice + made.following,
        rest=made.rest,
        left=np.empty((0, 3)),
        halts=tuple(halt for halt in held.halts if splice - _SNAPSHOTS_KEPT < halt[0] < splice),
    )


def snapshots_at(held: HeldFlight, splice: int) -> NDArray:
    """Return (L, 31), the simulated vehicle at a setpoint; behind the last it hovers."""
    return np.asarray(held.snapshots[:, min(max(splice - held.begin, 0), held.snapshots.shape[1] - 1)])


def halt(held: HeldFlight, splice: int, limits: Limits) -> Replanned | HeldFlight:
    """Return the proposal to leave what is held at setpoint `splice` and to come to rest as soon as may be on its path.

    That is a stop as there is one from each setpoint, but the shortest that keeps what stops may reach and that the
    vehicle can follow. Where it stops as soon behind the part of a plan that is committed, that is held. Raises
    InfeasibleError where it rests as soon anyway, or no stop passes: then it rests at the end of what is held.
    """
    held = at_rest_from(held, splice, limits)
    splice, _ = _leaving(held, splice, keep=False)
    ends = _rests_next(held, splice)
    if sooner := [duration for duration in STOPS if duration < ends - splice / RATE]:
        encoded = _encoded_from(held.flown, splice, limits)
        for duration in sooner:
            with suppress(InfeasibleError, NotCertifiedError):
                return _stop_along(encoded, held, splice, duration, limits)
    if held.unfinished:
        return given_up(held, limits)
    raise InfeasibleError(
        f"{max(ends - splice / RATE, 0.0):.1f} s before its end, the vehicle cannot stop sooner",
        where="stop",
        hint="it rests at the end of what is committed",
    )


def _rests_next(held: HeldFlight, splice: int) -> float:
    """Return when one who goes on at setpoint `splice` rests next, s from setpoint 0."""
    ahead = [(end - LOOKS_BACK) / RATE for begin, end in held.halts if begin > splice]
    return min([held.ends if held.stops_from is None else (held.stops_from + STOP) / RATE, *ahead])


def replan_behind_stop(
    held: HeldFlight,
    splice: int,
    waypoints: ArrayLike,
    limits: Limits,
    *,
    yaw_angle: float = 0.0,
    part: int | None = None,
) -> Replanned:
    """Return the proposal to go through waypoints, (K, 3) m, from rest, behind the stop from setpoint `splice` on.

    For where no way leads there from the motion. The `stop` is to be proposed first, unless the vehicle stops as soon
    anyway. Raises as replan() and halt() do; then nothing is to be proposed.
    """
    stop = halt(held, splice, limits)
    resting = stop if isinstance(stop, HeldFlight) else stop.held
    begins = max(splice, resting.exact_from)
    if isinstance(stop, Replanned) and bound_already(resting, begins, waypoints, limits) is not None:
        return stop
    made = replan(resting, begins, waypoints, limits, yaw_angle=yaw_angle, part=part)
    return made if isinstance(stop, HeldFlight) else replace(made, stop=stop)


def following(replanned: Replanned, commitment: Commitment) -> Replanned:
    """Return what was made behind a stop, to be proposed now that the pilot is committed to that."""
    proposal = replace(replanned.proposal, follows=commitment.checksum)
    return replace(replanned, proposal=proposal, held=replace(replanned.held, commitment=commitment), stop=None)


def stop_within(held: HeldFlight, splice: int, duration: float, limits: Limits) -> Replanned:
    """Return the proposal to stop along the path from the setpoint behind `splice` on, within `duration`, s.

    Raises NotCertifiedError where the stop exceeds what stops may reach or its dry run does not pass, InfeasibleError
    where link loss or a gap within it would end badly.
    """
    return _stop_along(_encoded_from(held.flown, splice, limits), held, splice, duration, limits)


def _encoded_from(flown: JoinedTrajectory, splice: int, limits: Limits, count: int | None = None) -> EncodedFlight:
    """Return the setpoints of a flight, from one on; so many, or all."""
    return encode_trajectory(flown.since(splice / RATE), gains=gains_under(limits), space=limits.space, count=count)


def _stop_along(encoded: EncodedFlight, held: HeldFlight, splice: int, duration: float, limits: Limits) -> Replanned:
    """Return what stop_within() does; `encoded` are the setpoints of what is held from the splice on."""
    motion, gains, space = encoded.motion, encoded.gains, encoded.space
    first, second = np.array([0]), np.array([1])
    stop = encode_stops(motion, RATE, duration, second, gains, space)
    certify_stops(stop, motion, limits, RATE, second, gains, space).require(limits)
    rows, rest = stop[0], stop[0, -1:]
    hovering = np.repeat(rest, round(HOLD * RATE), axis=0)
    payloads = np.concatenate([encoded.payloads[:1], rows, hovering])
    # From within a stop, what is left of it is the stop; it is as long as all others, the end of it a hover.
    whole = encode_stops(motion, RATE, DURATION, first, gains, space)
    padded = np.concatenate([rows, np.repeat(rest, whole.shape[1], axis=0)])
    after = [padded[min(row, len(rows)) :][: whole.shape[1]] for row in range(len(payloads) - 1)]
    stops = np.concatenate([whole, np.stack(after)])
    starts = snapshots_at(held, splice)
    _rehearse_stop(payloads, duration, limits, starts, held.flown.at(splice / RATE).position)
    lost = link_loss_at_walls(payloads, limits, starts=starts)
    require_inside(lost, limits)
    meet_gaps(payloads, limits, starts)
    resting = _resting(held, rest_behind(motion, 1, RATE, duration), splice + 1, splice + len(rows), limits)
    later = replace(resting, begin=splice, simulated=Simulated(lost.snapshots))
    proposal = propose(held.commitment, splice, payloads, stops, len(stops) - 2)
    return Replanned(proposal, later, None, splice / RATE)


def _rehearse_stop(payloads: NDArray, duration: float, limits: Limits, starts: NDArray, begin: NDArray) -> None:
    """Raise NotCertifiedError where the dry run of a stop fails, or strays as far as only a shorter stop does.

    `begin`, (3,) m, is where the vehicle is wanted when the payloads begin: how far it is from there is no fault of the
    stop. What motors can do is certified of the motion, which they follow late. Where a short stop leans from one side
    to the other at little thrust, controlling the attitude takes what is left of a motor; then the firmware lowers the
    thrust of all, and the vehicle sinks: by 0.2 m where it came over the top of a climb.
    """
    believed = as_believed(starts, limits)
    run = rehearse_setpoints(payloads, limits.airframe, limits.flight, snapshot=believed)
    run.require_passed()
    if duration >= DURATION:
        return
    _require_near(run, math.dist(believed[:3], begin) + STRAYS, duration)
    airframe, sluggish = as_most_sluggish(starts, limits)
    run = rehearse_setpoints(payloads, airframe, limits.flight, snapshot=sluggish)
    _require_near(run, math.dist(sluggish[:3], begin) + STRAYS_SLUGGISH, duration)


def _require_near(run: Rehearsal, most: float, duration: float) -> None:
    """Raise NotCertifiedError where a stop within a duration, s, strays by more than `most`, m, in its dry run."""
    if not run.deviation <= most:
        raise NotCertifiedError(
            f"within {duration:g} s the vehicle strays {run.deviation:.3f} m from the stop, more than {most:.3f} m",
            where="dry run",
            hint="stop within a longer time",
        )


def _resting(
    held: HeldFlight, rest: tuple[Triple, float], stops_from: int, rests_from: int, limits: Limits
) -> HeldFlight:
    """Return the flight that stops from a setpoint on, and from another on rests at a place, m, with a yaw, rad."""
    place, yaw = rest
    flown = held.flown.continued(rests_from / RATE, hover_at(place, yaw, HOVER, limits.airframe))
    exact_from = rests_from + LOOKS_BACK
    return replace(
        held, flown=flown, ahead=np.array([place]), reached=(HOVER,), exact_from=exact_from, stops_from=None, rest=None,
        left=np.empty((0, 3)), halts=(*held.halts, (stops_from, exact_from)),
    )  # fmt: skip


def _leaving(held: HeldFlight, splice: int, keep: bool) -> tuple[int, int]:
    """Return from which setpoint on another plan can be flown, not before `splice`, and which trajectory it leaves.

    With `keep` it is the last one, as the waypoints on it stay. Else the vehicle may turn off on the way to what is
    held last, but not within a stop.
    """
    if keep:
        begins = math.ceil(held.flown.starts[-1] * RATE - 1e-6) - SPLICE_AHEAD
        return max(splice, held.exact_from, begins), len(held.flown.starts) - 1
    for begin, end in held.halts:
        if begin <= splice < end:
            splice = end
    joint = (splice + SPLICE_AHEAD) / RATE
    return splice, max(int(np.searchsorted(held.flown.starts, joint + 1e-9, side="right")) - 1, 0)


def accepted(replanned: Replanned, commitment: Commitment) -> HeldFlight:
    """Return what is held once the pilot has accepted a proposal: it is committed to this."""
    return replace(replanned.held, commitment=commitment)


def _still_ahead(held: HeldFlight, leave: float, more: NDArray) -> tuple[NDArray, NDArray]:
    """Return the waypoints not yet passed at `leave`, s, with `more` behind them, and the nominal times to each."""
    last = held.flown.trajectories[-1]
    s = float(last.s_at(leave))
    here = last.path(s)
    kept = [
        number
        for number, (point, at) in enumerate(zip(held.ahead, held.reached, strict=True))
        if at > s and math.dist(point, here) >= MIN_SPACING
    ]
    times = np.diff([s, *(held.reached[number] for number in kept)])
    begin = held.ahead[kept[-1]] if kept else here
    onward = spaced(np.concatenate([begin[None], more]))
    new = centripetal_times(onward) if len(onward) > 1 else np.empty(0)
    return np.concatenate([held.ahead[kept].reshape(-1, 3), onward[1:]]), np.concatenate([times, new])
