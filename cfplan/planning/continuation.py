"""Plans that continue a motion, so that the path can change in flight.

The new plan takes over at a joint, a moment of the previous trajectory:

    before the joint   the previous trajectory is flown, unchanged
    at the joint       the new path has γ to γ'''' of the previous motion, and its profile begins with h, h', h'', ψ and
                       ψ', so attitude and body rates do not jump (vehicle/joint.py)
    after the joint    the new path leads through the waypoints to rest; it is chosen within milliseconds
                       (path/onward.py), and planned and certified like a plan before take-off

For a vehicle at rest there is no joint: the path begins at its hover, and the search may take longer. A joint is a
moment of the planned motion; air/ turns it into setpoints ahead of the clock.
"""

import math
import time
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.deadline import Deadline
from cfplan.errors import CfplanError, InfeasibleError, NotCertifiedError
from cfplan.geometry.continued import check_continued
from cfplan.geometry.min_snap import check_points
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import path_through
from cfplan.geometry.yaw import YawMode
from cfplan.numbers import coordinates
from cfplan.planners.expert.expert import plan_early
from cfplan.planners.task import PlanningTask
from cfplan.planning.path.onward import Departure, along, onward_paths, toward
from cfplan.planning.path.search import search
from cfplan.planning.path.variables import Knots
from cfplan.planning.plan import check_endurance, plan
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import default_nodes
from cfplan.safety.certificate import certify
from cfplan.safety.limits import Limits, PlanLimits
from cfplan.safety.space import check_space, inside
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.joint import joint_at
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import Trajectory

SLOWING, LEVEL_FOR = 1.5, 0.3  # m/s², deceleration to a lower speed limit, and s before it begins
STOPPING = 0.6  # s of the previous path, within which a stopping vehicle comes to rest
OVERSHOOT = 0.2  # s for which an accelerating vehicle continues to accelerate
ROOM = 0.005  # fraction of each limit that plans leave to the plan that continues them
ROOM_BETWEEN_POINTS = 0.6  # fraction of ROOM that may be exceeded between points, which saves rounds of tightening
SEARCH_TIMEOUT = 2.0  # s, for a vehicle at rest
PLANNER = "expert"  # it keeps boundary states, and takes some 10 ms for 10 m
_OTHER_WAYPOINTS = "give other waypoints"
INTERVALS_FACTOR = 0.85  # of the usual number: flights take 0.05 % longer, and planning 10 % less


class NoWayError(InfeasibleError):
    """Raised when no path was found from the state at a joint; a later joint may have one."""


@dataclass(frozen=True, slots=True)
class Continuation:
    """A plan that begins in the state at a joint, or at rest."""

    plan: Plan
    reached: tuple[float, ...]  # s on its path, of each waypoint


def continue_plan(
    trajectory: Trajectory,
    leave: float,
    waypoints: ArrayLike,
    limits: Limits,
    *,  # independent options
    reached: ArrayLike = (),
    yaw: YawMode = YawMode.FIXED,
    yaw_angle: float = 0.0,
    speed: float = math.inf,
    leave_room: bool = True,
) -> Continuation:
    """Return a certified plan that leaves a trajectory at `leave`, s, and goes through waypoints, (K, 3) m, to rest.

    The first J waypoints may be those of the previous path, at s = `reached`, (J,), on it: then the search also starts
    from the remainder of that path. In mode FIXED yaw turns to `yaw_angle`, rad, along the path. `speed`, m/s, is a
    limit that holds once the vehicle has gently slowed down to it. With `leave_room` the plan keeps a fraction ROOM
    below limits, so that it can be continued; a state at a limit may only have continuations without room.

    Raises:
        InputError: the waypoints are invalid, or the trajectory is at rest then.
        InfeasibleError: a waypoint lies outside the space, or none of the paths tried can be flown from this state.
    """
    joint = joint_at(trajectory, leave).timed(trajectory, 1.0)
    points = check_continued(joint.derivatives, waypoints)[1][1:]
    check_waypoints(points, limits)
    departure = Departure(joint.derivatives[0], joint.derivatives, joint.state, yaw, yaw_angle)
    begins = toward(departure, points, limits)
    if len(stays := np.asarray(reached, dtype=float)):
        begins.insert(0, along(trajectory, leave, stays, departure, points[len(stays) :], limits))
    made = _first_certified(begins, departure, limits, speed, leave_room=leave_room)
    if isinstance(made, Continuation):
        return made
    moving = float(np.linalg.norm(departure.velocity))
    away = float(np.linalg.norm(points[0] - departure.position))
    rest = trajectory.at(min(leave + STOPPING, trajectory.duration)).position
    raise NoWayError(
        f"from {moving:.2f} m/s no path leads through waypoint 1, {away:.2f} m away: {made}",
        where="waypoint 1",
        hint=f"give a waypoint farther on than {coordinates(rest, '.2f')} m, where it could rest, or stop first",
    )


def plan_from_rest(
    points: ArrayLike, limits: Limits, *, yaw_angle: float = 0.0, speed: float = math.inf
) -> Continuation:
    """Return a certified plan from rest at the first point, (K, 3) m, through the others to rest at the last one.

    If the short search used in motion finds no path, the full search follows, for up to SEARCH_TIMEOUT.

    Raises:
        InputError: the points do not make a path.
        InfeasibleError: one lies outside the space, or none of the paths tried can be flown.
    """
    given = np.asarray(points, dtype=float)
    check_points(given)
    check_waypoints(given[1:], limits)
    departure = Departure(given[0], yaw_angle=yaw_angle)
    made = _first_certified(toward(departure, given[1:], limits), departure, limits, speed, leave_room=True)
    if isinstance(made, Continuation):
        return made
    found = search(path_through(given), limits, Deadline.after(SEARCH_TIMEOUT)).knots
    with suppress(InfeasibleError):
        planned = plan(
            found.path, limits.airframe, limits, planner=PLANNER, yaw_angle=yaw_angle,
            speed_factor=min(speed / limits.plan.speed, 1.0),
        )  # fmt: skip
        return Continuation(planned, tuple(found.breaks[found.waypoint[1:]].tolist()))
    raise NoWayError(
        f"no path leads from rest through the waypoints: {made}", where="waypoint 1", hint=_OTHER_WAYPOINTS
    )


def check_waypoints(points: NDArray, limits: Limits) -> None:
    """Raise InfeasibleError where one of the waypoints, (K, 3) m, lies outside the space."""
    beyond, face = limits.space.nearest(points)
    if not (good := inside(beyond) | np.isnan(beyond)).all():  # NaN is refused when the path is made
        at = int(np.argmin(good))
        raise InfeasibleError(
            f"{coordinates(points[at], '.3f')} m is {beyond[at]:.3f} m too {limits.space.too(face[at])}",
            where=f"waypoint {at + 1}",
            hint="keep waypoints inside the space less its margin",
        )


def _first_certified(
    begins: list[Knots], departure: Departure, limits: Limits, speed: float, *, leave_room: bool
) -> Continuation | str:
    """Return the first certified plan along the paths that descents from `begins` find; or why there is none."""
    begun, failure = time.perf_counter(), ""
    tried = replace(limits, plan=with_room(limits.plan, limits.airframe)) if leave_room else limits
    at_rest = departure.state is None  # then the whole motion may be slowed
    factor = min(speed / limits.plan.speed, 1.0) if at_rest else 1.0
    for knots in onward_paths(begins, departure, tried, math.inf if at_rest else speed):
        path, caps = knots.path, None
        if departure.state is not None and speed < limits.plan.speed:
            caps = _slowing_to(speed, path, departure.state)
        task = PlanningTask(
            path, limits.airframe, tried.plan, round(INTERVALS_FACTOR * default_nodes(path, PLANNER)), departure.yaw,
            departure.yaw_angle, start=departure.state,
            speed_caps=caps if caps is None or tried is limits else caps.scaled(1.0 - ROOM),
        )  # fmt: skip
        try:
            check_space(path, limits.space)
            made = _plan(task, limits, caps, factor)
        except CfplanError as error:
            failure = error.what
            continue
        check_endurance(made.trajectory.duration, limits)
        reached = tuple(knots.breaks[knots.waypoint[1:]].tolist())
        return Continuation(replace(made, seconds=time.perf_counter() - begun), reached)
    return failure or "no path keeps the limits"


def _slowing_to(speed: float, path: Path, start: BoundaryState) -> SpeedCaps:
    """Return speed caps along a path, which fall from the vehicle's present speed."""
    s = np.linspace(0.0, path.end, 4 * default_nodes(path, PLANNER) + 1)
    moving = np.linalg.norm(path(s, 1), axis=1)
    length = np.append(0.0, np.cumsum((moving[1:] + moving[:-1]) / 2.0 * np.diff(s)))
    first = moving[0] * start.h**0.5
    gaining = moving[0] * start.dh / 2.0
    if moving[0] > 0.0:  # else it begins at rest, where γ' and γ'' are 0
        gaining += start.h * float(path(0.0, 1) @ path(0.0, 2)) / moving[0]
    highest = first + 0.1 + OVERSHOOT * max(gaining, 0.0)
    falling = np.sqrt(np.maximum(highest**2 - 2.0 * SLOWING * np.maximum(length - LEVEL_FOR * first, 0.0), 0.0))
    return SpeedCaps.of(s, np.maximum(falling, speed))


def with_room(limits: PlanLimits, airframe: Airframe, room: float = ROOM) -> PlanLimits:
    """Return limits that leave a fraction `room` of each to the plan that continues this one.

    A state at a limit can hardly be continued: almost no motion is feasible from it, and rounding exceeds the limit.
    """
    hover, less = airframe.hover_thrust, 1.0 - room
    return PlanLimits(
        speed=less * limits.speed,
        acceleration=less * limits.acceleration,
        angular_velocity=less * limits.angular_velocity,
        tilt=less * limits.tilt,
        motor_thrust_min=hover - less * (hover - limits.motor_thrust_min),
        motor_thrust_max=hover + less * (limits.motor_thrust_max - hover),
        specific_thrust_min=GRAVITY - less * (GRAVITY - limits.specific_thrust_min),
        angular_acceleration=less * limits.angular_acceleration,
    )


def _plan(task: PlanningTask, limits: Limits, caps: SpeedCaps | None, factor: float) -> Plan:
    """Return a plan, slowed by a factor and certified against the limits and `caps`; the task's limits may be lower.

    Raises InfeasibleError or NotCertifiedError if there is none.
    """
    solution = plan_early(task, ROOM_BETWEEN_POINTS * ROOM) if task.limits is not limits.plan else plan_early(task)
    if solution.profile is None:
        reason = f" ({' '.join(solution.reason.split())})" if solution.reason else ""
        raise InfeasibleError(f"{solution.status}{reason}", hint=_OTHER_WAYPOINTS)
    profile = solution.profile if factor == 1.0 else solution.profile.slowed(factor)
    trajectory = Trajectory(task.path, profile, task.airframe)
    certificate = certify(trajectory, limits.plan, limits.space, caps)
    if not certificate.passed:
        worst = certificate.worst
        raise NotCertifiedError(
            f"the plan exceeds the limit on {worst.name} by {worst.share - 1.0:.2%}", hint=_OTHER_WAYPOINTS
        )
    return Plan(
        path=task.path,
        airframe=task.airframe,
        limits=limits,
        trajectory=trajectory,
        certificate=certificate,
        planner=PLANNER,
        nodes=task.nodes,
        repair_speed_factor=1.0,
        speed_factor=factor,
        seconds=0.0,
        notes=(),
        joints=solution.joints,
    )
