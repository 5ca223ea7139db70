"""Replan from the current timeline: turn a request into a certified proposal for the pilot.

The motion changes at the first joint for which the proposal can be in time: the setpoints up to there stay as they are
committed, and a plan that begins in the state at the joint is encoded and certified behind it. If no path leads on from
there, or if link loss or a gap would end badly, later joints and lower speeds are tried, and finally a plan from rest
behind a stop.
"""

import itertools
import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.air.certifying import EndsBadlyError, certify_beginning, certify_whole
from cfplan.air.requests import PathRequest, Wish
from cfplan.air.stopping import halt
from cfplan.air.timeline import Replanned, Timeline, joint_of
from cfplan.errors import CfplanError, InfeasibleError, InputError, NotCertifiedError
from cfplan.flight.setpoints.commitment import propose, spliced
from cfplan.geometry.min_snap import MIN_SPACING, spaced
from cfplan.planning.continuation import Continuation, NoWayError, check_waypoints, continue_plan, plan_from_rest
from cfplan.safety.limits import Limits

LOWER_SPEEDS = (1.2, 0.7)  # m/s, tried in order if the flight would end badly at full speed
JOINT_DELAYS = (0, 5, 15, 35)  # setpoints by which the joint is delayed, tried in order
SLOWDOWN_MARGIN = 3  # setpoints after the splice at which a slower plan begins, as planning the next part took time
SPEED_STEP = 0.75  # factor by which a request lowers the speed; a request to fly faster undoes it


class PlanOptions(TypedDict):
    """Keyword arguments of continue_plan()."""

    yaw_angle: float  # rad
    speed: float  # m/s
    leave_room: bool


@dataclass(frozen=True, slots=True, eq=False)
class ReplanSpec:
    """The specification of a new plan."""

    points: NDArray  # (K, 3) m, waypoints
    keep: bool  # whether the waypoints follow those ahead; else they replace them
    yaw_angle: float  # rad, final yaw
    part: int | None = None  # setpoints to commit at once, before the stop; None: all
    speed: float = math.inf  # m/s, at most
    leave_room: bool = True  # see continue_plan()

    @property
    def options(self) -> "PlanOptions":
        """Return the keyword arguments of continue_plan()."""
        return {"yaw_angle": self.yaw_angle, "speed": self.speed, "leave_room": self.leave_room}


def answer_request(
    timeline: Timeline, request: PathRequest, splice: int, limits: Limits, part: int | None = None
) -> Replanned | Timeline:
    """Return the proposal that meets a request from setpoint `splice` on; `part` as in replan().

    Returns the new timeline instead if nothing need be proposed. Raises a CfplanError if no plan meets the request.
    """
    yaw = _final_yaw(timeline)
    match request.wish:
        case Wish.STOP:
            return halt(timeline, splice, limits)
        case Wish.SLOWER | Wish.FASTER:
            now = min(timeline.speed, limits.plan.speed)
            slowed = timeline.slowed_to(now * SPEED_STEP if request.wish is Wish.SLOWER else now / SPEED_STEP)
            nothing_ahead = timeline.stopping and not len(timeline.left)
            if nothing_ahead or joint_of(splice) >= timeline.ends:
                return slowed
            return _search(slowed, splice, ReplanSpec(np.empty((0, 3)), True, yaw, part), limits)
    keep = request.wish is Wish.EXTEND
    if (bound := bound_already(timeline, splice, request.waypoints, limits, keep=keep)) is not None:
        return bound
    try:
        return replan(timeline, splice, request.waypoints, limits, keep=keep, yaw_angle=yaw, part=part)
    except (NoWayError, EndsBadlyError, NotCertifiedError):
        if not keep:
            with suppress(CfplanError):
                return replan_behind_stop(timeline, splice, request.waypoints, limits, yaw_angle=yaw, part=part)
        raise


def replan(
    timeline: Timeline,
    splice: int,
    waypoints: ArrayLike,
    limits: Limits,
    *,  # options, each of which is used without the others
    keep: bool = False,
    yaw_angle: float = 0.0,
    part: int | None = None,
) -> Replanned:
    """Return the proposal to leave a timeline at setpoint `splice` and to go through waypoints, (K, 3) m, to rest.

    The motion changes there, or a little later if it cannot change at once. With `keep`, the waypoints follow those
    ahead, and the motion changes only once the last trajectory, which leads to these, has begun; else they replace
    them. Waypoints closer than MIN_SPACING to the one before, or to where the plan begins, are left out. If the vehicle
    rests by then, the plan begins from rest. If link loss or a gap would end badly, the vehicle flies slower. The
    proposal has `part` setpoints and the stop behind them; without `part`, all setpoints.

    Raises:
        InputError: the waypoints are not rows of three numbers.
        InfeasibleError: no plan leads through them from there, or link loss would end outside the walls.
        NotCertifiedError: the plan, its bytes, a stop, a gap or the dry run does not pass.
    """
    points = np.asarray(waypoints, dtype=float)
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
        raise InputError(f"waypoints of shape {points.shape}", where="waypoints", hint="give rows of x, y, z in metres")
    check_waypoints(points, limits)
    return _search(timeline, splice, ReplanSpec(points, keep, yaw_angle, part), limits)


def replan_behind_stop(
    timeline: Timeline,
    splice: int,
    waypoints: ArrayLike,
    limits: Limits,
    *,
    yaw_angle: float = 0.0,
    part: int | None = None,
) -> Replanned:
    """Return the proposal to go through waypoints, (K, 3) m, from rest, behind the stop from setpoint `splice` on.

    For waypoints to which no path leads from the present motion. The `stop` of the result must be proposed first; it is
    None if the vehicle stops as soon anyway. Raises as replan() and halt() do; then nothing is to be proposed.
    """
    stop = halt(timeline, splice, limits)
    resting = stop if isinstance(stop, Timeline) else stop.accepted(spliced(timeline.commitment, stop.proposal, splice))
    begins = max(splice, resting.stops[-1][1] if resting.stops else 0)
    if isinstance(stop, Replanned) and bound_already(resting, begins, waypoints, limits) is not None:
        return stop
    made = replan(resting, begins, waypoints, limits, yaw_angle=yaw_angle, part=part)
    return made if isinstance(stop, Timeline) else replace(made, stop=stop)


def next_part(timeline: Timeline, splice: int, limits: Limits, part: int) -> Replanned | Timeline:
    """Return the proposal of the next `part`, setpoints, of a plan that is committed in parts, from `splice` on.

    If it would end badly, the vehicle flies slower: from shortly behind `splice` on, or else from the new part on. If
    it will have stopped, because this call comes too late, it goes on from rest. Returns the timeline if all is
    committed and nothing need be proposed. Raises as replan() does; then the vehicle rests behind the part before.
    """
    timeline = timeline.for_plans_from(splice, limits)
    rest_of_it = ReplanSpec(np.empty((0, 3)), True, _final_yaw(timeline), part)
    if timeline.part_ends is not None:
        ahead = timeline.part_ends - 1  # all before it is committed already
        with suppress(EndsBadlyError, NotCertifiedError):
            made = certify_beginning(timeline.onward(ahead, timeline.motion), part, limits, foresee=False)
            proposal = propose(
                timeline.commitment, ahead, made.payloads, made.stops, made.ending,
                goes_on=True, unfinished=made.following is not None,
            )  # fmt: skip
            return Replanned(proposal, timeline.with_certified(ahead, made), None, joint_of(ahead))
        with suppress(InfeasibleError, NotCertifiedError):  # the sooner it slows down the better
            return _search(timeline, min(splice + SLOWDOWN_MARGIN, ahead), rest_of_it, limits, slower=True)
        splice = ahead
    return _search(timeline, splice, rest_of_it, limits) if timeline.unfinished else timeline


def bound_already(
    timeline: Timeline, splice: int, waypoints: ArrayLike, limits: Limits, *, keep: bool = False
) -> Timeline | None:
    """Return the timeline if the vehicle already flies through these waypoints, or rests there; else None."""
    points = np.asarray(waypoints, dtype=float).reshape(-1, 3)
    if not len(points):  # no waypoints were requested
        return None
    resting = timeline.for_plans_from(splice, limits)
    splice, _ = resting.leaving(splice, keep=keep)
    joint = joint_of(splice)
    here, last = resting.motion.at(joint).position, resting.motion.at(resting.ends).position
    s = float(resting.motion.trajectories[-1].s_at(max(joint - resting.motion.starts[-1], 0.0)))
    unreached = resting.ahead[np.array(resting.reached) > s]
    ahead = spaced(np.concatenate([here[None], unreached, last[None], resting.left]))
    if keep:
        return timeline if len(spaced(np.concatenate([ahead[-1:], points]))) == 1 else None
    wanted = spaced(np.concatenate([here[None], points]))
    if wanted.shape == ahead.shape and (np.linalg.norm(wanted - ahead, axis=1) < MIN_SPACING).all():
        return timeline
    return resting.cut_short(limits, going_on=False) if len(wanted) == 1 and joint >= resting.ends else None


def _search(timeline: Timeline, splice: int, spec: ReplanSpec, limits: Limits, *, slower: bool = False) -> Replanned:
    """Return the first certified plan among later joints and lower speeds; with `slower`, at lower speeds alone."""
    splice, _ = timeline.for_plans_from(splice, limits).leaving(splice, keep=spec.keep)
    fastest = min(timeline.speed, limits.plan.speed)
    speeds = [*([] if slower else [fastest]), *(speed for speed in LOWER_SPEEDS if speed < fastest)]
    refused: InfeasibleError | None = None
    for speed in speeds:
        for leave_room, delay in itertools.product((True, False), JOINT_DELAYS):
            if delay and timeline.part_ends is not None and splice + delay >= timeline.part_ends:
                continue
            try:
                return _replan_at(timeline, splice + delay, replace(spec, speed=speed, leave_room=leave_room), limits)
            except EndsBadlyError as error:
                refused = error
                break
            except NoWayError as error:
                refused = refused or error
                if joint_of(splice + delay) > timeline.ends:
                    break
        else:
            break  # no path exists at this speed, so none will at a lower one
    if refused is None:
        raise InfeasibleError("it flies as slowly as may be", where="request", hint="nothing need be flown")
    raise refused


def _replan_at(timeline: Timeline, splice: int, spec: ReplanSpec, limits: Limits) -> Replanned:
    """Return the certified plan that leaves a timeline at a setpoint."""
    timeline = timeline.for_plans_from(splice, limits)
    splice, left = timeline.leaving(splice, keep=spec.keep)
    joint = joint_of(splice)
    points, made = _planned(timeline, joint, left, spec, limits)
    onward = timeline.onward(splice, timeline.motion.continued(joint, made.plan.trajectory))
    part = spec.part
    passed = certify_whole(onward, limits) if part is None else certify_beginning(onward, part, limits)
    motion = timeline.motion.continued(joint, made.plan.trajectory)
    later = replace(timeline, motion=motion, ahead=points, reached=made.reached).with_certified(splice, passed)
    unfinished = passed.following is not None
    proposal = propose(timeline.commitment, splice, passed.payloads, passed.stops, passed.ending, unfinished=unfinished)
    return Replanned(proposal, later, made.plan, joint)


def _planned(
    timeline: Timeline, joint: float, left: int, spec: ReplanSpec, limits: Limits
) -> tuple[NDArray, Continuation]:
    """Return the waypoints, (K, 3) m, and a plan through them that leaves trajectory `left` at a joint, s."""
    leave, trajectory = joint - timeline.motion.starts[left], timeline.motion.trajectories[left]
    if leave >= trajectory.duration:
        place = timeline.motion.at(joint)
        kept = [timeline.left] if spec.keep else []
        points = spaced(np.concatenate([place.position[None], *kept, spec.points]))
        if len(points) < 2:
            raise InfeasibleError("the vehicle rests there already", where="request", hint="nothing need be flown")
        return points[1:], plan_from_rest(points, limits, yaw_angle=float(place.yaw), speed=spec.speed)
    if not spec.keep:
        state = trajectory.at(leave)
        points = spaced(np.concatenate([state.position[None], spec.points]))[1:]
        if not len(points):
            raise NoWayError(
                f"the vehicle passes it at {float(np.linalg.norm(state.velocity)):.2f} m/s",
                where="waypoint 1",
                hint="stop first, then ask for it again",
            )
        return points, continue_plan(trajectory, leave, points, limits, **spec.options)
    ahead = timeline.still_ahead(leave)
    stays = timeline.ahead[ahead].reshape(-1, 3)
    begin = stays[-1:] if ahead else trajectory.at(leave).position[None]
    points = np.concatenate([stays, spaced(np.concatenate([begin, spec.points]))[1:]])
    if not len(points):
        raise InfeasibleError(
            "the last waypoint is all but reached", where="request",
            hint="ask for waypoints instead; they are flown so",
        )  # fmt: skip
    reached = [timeline.reached[number] for number in ahead]
    return points, continue_plan(trajectory, leave, points, limits, reached=reached, **spec.options)


def _final_yaw(timeline: Timeline) -> float:
    return float(timeline.motion.at(timeline.ends).yaw)
