"""Replanning: from what is committed and a request to a proposal that is certified like any plan, for the pilot.

A held flight is what the planner knows of what the pilot is bound to fly: the trajectories behind the bytes, and the
simulated vehicle at each setpoint. So what is checked of a new plan is checked of the whole flight: bytes, stops, link
loss, gaps and the dry run go on from the splice as if the flight had been planned so from its beginning.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InfeasibleError, InputError, NotCertifiedError
from cfplan.flight.setpoints.commitment import SPLICE_AHEAD, Commitment, Proposal, propose
from cfplan.flight.setpoints.encoding import HOLD, RATE, EncodedFlight, check_bytes, encode_trajectory
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stop_certificate import certify_stops, encode_certified_stops
from cfplan.flight.setpoints.stops import DURATION, encode_stops
from cfplan.flight.telemetry import Triple
from cfplan.geometry.min_snap import MIN_SPACING, centripetal_times, min_snap
from cfplan.planning.continuation import NoWayError, check_waypoints, continue_plan
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan
from cfplan.preparation.link_loss_assessment import OUTSIDE_HINT, assess_link_loss_of_stops
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import dry_run
from cfplan.simulation.glitches import glitch_where_nearly_lost
from cfplan.simulation.link_loss import as_believed, link_loss_at_walls
from cfplan.vehicle.hover import hover_at
from cfplan.vehicle.joint import JoinedTrajectory
from cfplan.vehicle.rotations import yaw_of

SLOWER = (1.2, 0.7)  # m/s, at which a flight is tried that would end badly at full speed
LATER = (0, 15, 35)  # setpoints by which the vehicle may fly on before it turns off, where it cannot do so at once
LEAST_SPEED = 0.2  # m/s, to which requests may lower the speed
PACE = 0.75  # by which a request lowers the speed; one to raise it undoes that
HOVER = 0.05  # s, of the motion that a hover counts as
STOPS = (0.46, 0.48, 0.5, 0.52, 0.54, 0.55, 0.56, 0.58, 0.6, 0.65, 0.7, 0.8, 1.0, DURATION)
"""s within which a request to stop is tried to be met. From 2 m/s straight on 0.54 s brake at 6.9 m/s², a tilt of 35°;
where the vehicle turns or slows down already it is more or less."""


class EndsBadlyError(InfeasibleError):
    """After link loss or a gap the vehicle would end outside the walls, or turn over."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldFlight:
    """What is committed, and what it was made from; its clock is 0 at setpoint 0."""

    commitment: Commitment
    flown: JoinedTrajectory
    ahead: NDArray  # (K, 3) m, waypoints of the last plan, in order
    reached: tuple[float, ...]  # s on the last plan's path, of each of them
    begin: int  # number of the setpoint of the first snapshot
    snapshots: NDArray  # (L, N, 31) of the simulated vehicle at each setpoint, for each motor lag
    speed: float = math.inf  # m/s, at which new plans fly at most, as was asked for; the limits' counts besides
    exact_from: int = 0
    """Number of the setpoint from which on the trajectories are those behind the bytes: in a stop before it they are
    those that it brakes along."""

    @property
    def ends(self) -> float:
        """Return when the motion ends, s."""
        return self.flown.duration


@dataclass(frozen=True, slots=True, eq=False)
class Replanned:
    """A proposal, what will be held once the pilot has accepted it, and the plan behind it."""

    proposal: Proposal
    held: HeldFlight
    plan: Plan | None  # None for a stop, which brakes along the plan before
    joint: float  # s from setpoint 0, from when on the motion is another


def hold(planned: Plan, waypoints: ArrayLike) -> HeldFlight:
    """Return what is held of a plan that begins at rest, through waypoints (K, 3) m with centripetal times.

    The first waypoint is its start. Raises InfeasibleError or NotCertifiedError where it does not pass what replan()
    asks of plans.
    """
    points = np.asarray(waypoints, dtype=float)
    flown = JoinedTrajectory((planned.trajectory,), (0.0,))
    encoded, stops, snapshots = certified(flown, planned.limits, None)
    reached = tuple(np.cumsum(centripetal_times(points)).tolist())
    return HeldFlight(Commitment(0, encoded.payloads, stops), flown, points[1:], reached, 0, snapshots)


def hold_hover(position: Triple, yaw: float, limits: Limits) -> HeldFlight:
    """Return what is held of a vehicle that hovers at a position, m, with a yaw, rad, until it is asked to fly.

    Raises InfeasibleError where that lies outside the space, or link loss there would end outside the walls.
    """
    beyond = float(limits.space.beyond(np.array([position])).max())
    if beyond > 0.0:
        x, y, z = position
        raise InfeasibleError(
            f"the hover at ({x:.2f}, {y:.2f}, {z:.2f}) m is {beyond:.2f} m too far out",
            where="take-off",
            hint="take off to a height inside the space less its margin, and nearer to the middle of the room",
        )
    flown = JoinedTrajectory((hover_at(position, yaw, HOVER, limits.airframe),), (0.0,))
    encoded, stops, snapshots = certified(flown, limits, None)
    place = np.array([position], dtype=float)
    return HeldFlight(Commitment(0, encoded.payloads, stops), flown, place, (HOVER,), 0, snapshots)


def replan(
    held: HeldFlight, splice: int, waypoints: ArrayLike, limits: Limits, *, keep: bool = False, yaw_angle: float = 0.0
) -> Replanned:
    """Return the proposal to leave what is held at setpoint `splice` and to go through waypoints, (K, 3) m, to rest.

    The motion changes SPLICE_AHEAD setpoints after the splice, or a little later where it cannot do so at once; never
    before what is held last has begun. With `keep`, the waypoints follow those that are ahead there; else they replace
    them. Where the vehicle rests by then, the plan begins from rest. Where link loss or a gap would end badly, the
    vehicle flies slower.

    Raises:
        InputError: what is given are no waypoints.
        InfeasibleError: no plan leads through them from there, or link loss would end outside the walls.
        NotCertifiedError: the plan, its bytes, a stop, a gap or the dry run does not pass.
    """
    points = np.asarray(waypoints, dtype=float)
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
        raise InputError(f"waypoints of shape {points.shape}", where="waypoints", hint="give rows of x, y, z in metres")
    check_waypoints(points, limits)
    return _replan_within(held, splice, points, limits, keep, yaw_angle)


def pace(held: HeldFlight, splice: int, speed: float, limits: Limits, *, yaw_angle: float = 0.0) -> Replanned | None:
    """Return the proposal to fly what is ahead at setpoint `splice` at a speed, m/s, at most; None where it rests.

    Then nothing need be proposed: what is asked for later flies so. See at_pace(). Raises as replan() does.
    """
    if (splice + SPLICE_AHEAD) / RATE >= held.ends:
        return None
    return _replan_within(at_pace(held, speed), splice, np.empty((0, 3)), limits, True, yaw_angle)


def at_pace(held: HeldFlight, speed: float) -> HeldFlight:
    """Return the same flight, whose new plans fly at a speed, m/s, at most."""
    return replace(held, speed=max(speed, LEAST_SPEED))


def _replan_within(
    held: HeldFlight, splice: int, points: NDArray, limits: Limits, keep: bool, yaw_angle: float
) -> Replanned:
    """Return what replan() does, at the speed that is asked for, or slower where it must be."""
    fastest = min(held.speed, limits.plan.speed)
    refused: InfeasibleError | None = None
    for speed in (fastest, *(slower for slower in SLOWER if slower < fastest)):
        for later in LATER:
            try:
                return _replan_at(speed, held, splice + later, points, limits, keep, yaw_angle)
            except EndsBadlyError as error:
                refused = error
                break  # slower
            except NoWayError as error:
                refused = refused or error
                if (splice + later + SPLICE_AHEAD) / RATE > held.ends:
                    break
        else:
            break
    assert refused is not None
    raise refused


def _replan_at(
    speed: float, held: HeldFlight, splice: int, points: NDArray, limits: Limits, keep: bool, yaw_angle: float
) -> Replanned:
    """Return what replan() does, at that speed, m/s, or less."""
    splice = _not_before(held, splice)
    joint = (splice + SPLICE_AHEAD) / RATE
    if joint >= held.ends:
        place = held.flown.at(held.ends)
        points = np.concatenate([place.position[None], points])
        planned = plan(
            min_snap(points, times=centripetal_times(points)),
            limits.airframe,
            limits,
            planner="expert",
            yaw_angle=float(place.yaw),
            speed_factor=min(speed / limits.plan.speed, 1.0),
        )
        reached = tuple(np.cumsum(centripetal_times(points)).tolist())
        points = points[1:]
    else:
        leave = joint - held.flown.starts[-1]
        times = None
        if keep:
            kept, times = _still_ahead(held, leave, points)
            points = np.concatenate([kept, points])
            if not len(points):
                raise InfeasibleError(
                    "the last waypoint is all but reached",
                    where="request",
                    hint="ask for waypoints instead; they are flown so",
                )
        made = continue_plan(
            held.flown.trajectories[-1], leave, points, limits, times=times, yaw_angle=yaw_angle, speed=speed
        )
        planned, reached = made.plan, made.reached
    flown = held.flown.continued(joint, planned.trajectory)
    row = min(splice - held.begin, held.snapshots.shape[1] - 1)
    encoded, stops, snapshots = certified(flown.since(splice / RATE), limits, held.snapshots[:, row])
    proposal = propose(held.commitment, splice, encoded.payloads, stops)
    later = HeldFlight(held.commitment, flown, points, reached, splice, snapshots, held.speed)
    return Replanned(proposal, later, planned, joint)


def halt(held: HeldFlight, splice: int, limits: Limits) -> Replanned:
    """Return the proposal to leave what is held at setpoint `splice` and to come to rest as soon as may be on its path.

    That is a stop as there is one from each setpoint, but the shortest that keeps what stops may reach. Raises
    InfeasibleError where the vehicle rests as soon anyway, or no stop passes: then it rests at the end of what is held.
    """
    splice = max(splice, held.exact_from)
    left = held.ends - splice / RATE
    if sooner := [duration for duration in STOPS if duration < left]:
        encoded = _encoded_from(held, splice, limits)
        for duration in sooner:
            with suppress(InfeasibleError, NotCertifiedError):
                return _stop_along(encoded, held, splice, duration, limits)
    raise InfeasibleError(
        f"{max(left, 0.0):.1f} s before its end, the vehicle cannot stop sooner",
        where="stop",
        hint="it rests at the end of what is committed",
    )


def stop_within(held: HeldFlight, splice: int, duration: float, limits: Limits) -> Replanned:
    """Return the proposal to stop along the path from the setpoint behind `splice` on, within `duration`, s.

    Raises NotCertifiedError where the stop exceeds what stops may reach, InfeasibleError where link loss or a gap
    within it would end badly.
    """
    return _stop_along(_encoded_from(held, splice, limits), held, splice, duration, limits)


def _encoded_from(held: HeldFlight, splice: int, limits: Limits) -> EncodedFlight:
    """Return the setpoints of what is held, from one on."""
    return encode_trajectory(held.flown.since(splice / RATE), gains=gains_under(limits), space=limits.space)


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
    starts = held.snapshots[:, min(splice - held.begin, held.snapshots.shape[1] - 1)]
    lost = link_loss_at_walls(payloads, limits, starts=starts)
    if not lost.worst.beyond <= 0.0 and not limits.link_loss.only_warn:
        raise EndsBadlyError(str(lost.worst), where="link loss", hint=OUTSIDE_HINT)
    glitches = glitch_where_nearly_lost(payloads, limits, start=as_believed(starts, limits))
    if glitches.lost.any():
        raise EndsBadlyError(str(glitches), where="glitches", hint="plan with a lower speed or acceleration")
    end, rests_from = decode(rest), splice + len(rows)
    x, y, z = end.position[0].tolist()
    qx, qy, qz, qw = end.quaternion[0].tolist()
    hover = hover_at((x, y, z), yaw_of((qx, qy, qz, qw)), HOVER, limits.airframe)
    flown = held.flown.continued(rests_from / RATE, hover)
    later = HeldFlight(
        held.commitment, flown, end.position, (HOVER,), splice, lost.snapshots, held.speed, rests_from
    )  # fmt: skip
    return Replanned(propose(held.commitment, splice, payloads, stops), later, None, splice / RATE)


def _not_before(held: HeldFlight, splice: int) -> int:
    """Return the splice, or the first whose joint is not before what is held last begins."""
    return max(splice, held.exact_from, math.ceil(held.flown.starts[-1] * RATE - 1e-6) - SPLICE_AHEAD)


def accepted(replanned: Replanned, commitment: Commitment) -> HeldFlight:
    """Return what is held once the pilot has accepted a proposal: it is committed to this."""
    return replace(replanned.held, commitment=commitment)


def _still_ahead(held: HeldFlight, leave: float, more: NDArray) -> tuple[NDArray, NDArray]:
    """Return the waypoints not yet passed at `leave`, s, and the nominal times to each of them and to those after."""
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
    new = centripetal_times(np.concatenate([begin[None], more])) if len(more) else np.empty(0)
    return held.ahead[kept].reshape(-1, 3), np.concatenate([times, new])


def certified(
    flown: JoinedTrajectory, limits: Limits, starts: NDArray | None
) -> tuple[EncodedFlight, NDArray, NDArray]:
    """Return setpoints, stops and snapshots of a flight that goes on from snapshots (L, 31) or from hover.

    All of it is checked like a plan before take-off. Raises EndsBadlyError or NotCertifiedError where it does not pass.
    """
    encoded = encode_trajectory(flown, gains=gains_under(limits), space=limits.space)
    believed = None if starts is None else as_believed(starts, limits)

    def stop_everywhere() -> NDArray:
        stops, passed = encode_certified_stops(encoded.motion, limits, RATE, encoded.gains, encoded.space)
        passed.require(limits)
        return stops

    def lose_link() -> NDArray:
        lost = link_loss_at_walls(encoded.payloads, limits, starts=starts)
        if not lost.worst.beyond <= 0.0 and not limits.link_loss.only_warn:
            raise EndsBadlyError(str(lost.worst), where="link loss", hint=OUTSIDE_HINT)
        if not limits.link_loss.only_warn:
            within = assess_link_loss_of_stops(encoded, limits, lost, margin=0.0, stops=stops.result())
            if not within.passed:
                what = f"{within.what} from {within.time[within.worst]:.2f} s on {within.describe(within.worst)}"
                raise EndsBadlyError(what, where="link loss", hint=OUTSIDE_HINT)
        return lost.snapshots

    def meet_gaps() -> None:
        glitches = glitch_where_nearly_lost(encoded.payloads, limits, start=believed)
        if glitches.lost.any():
            raise EndsBadlyError(str(glitches), where="glitches", hint="plan with a lower speed or acceleration")

    def rehearse() -> None:
        check_bytes(encoded, flown, limits.plan)
        dry_run(encoded, flown, limits.airframe, limits.flight, snapshot=believed).require_passed()

    with ThreadPoolExecutor() as pool:  # compiled loops and most of numpy run side by side
        stops = pool.submit(stop_everywhere)
        snapshots = pool.submit(lose_link)
        gaps, rehearsed = pool.submit(meet_gaps), pool.submit(rehearse)
        gaps.result()
        rehearsed.result()
        return encoded, stops.result(), snapshots.result()
