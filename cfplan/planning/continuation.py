"""Plans that continue a motion: the path may change while it is flown.

A path laid from where the vehicle is, with the velocity that it has, may swing far out before its first waypoint, or
turn too sharply for its speed. That depends on the nominal time that its first segment takes, and on the unit of s in
which its start is given: that of the path left, which keeps the curve where waypoints stay, or time, which is gentle
where the path left is about to stop. Where all of these swing outside the space, guides keep the path near the
straight lines between waypoints. Where all that was ahead is dropped, the vehicle may first go on a little on the path
left, and brake there; where waypoints stay, it loses less time if it is asked again a little later. Several paths are
tried, first the one that looks fastest by a cheap estimate; those on the path left come late, as the motion changes
late on them.
"""

import math
import time
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import CfplanError, InfeasibleError
from cfplan.geometry.continued import check_continued, continued_through
from cfplan.geometry.guides import with_guides
from cfplan.geometry.min_snap import centripetal_times, check_times, min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.features import REFERENCE, ScaledLimits, node_features, scaled_limits
from cfplan.numbers import coordinates
from cfplan.planners.expert.expert import can_begin, plan_early
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import check_endurance
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import default_nodes
from cfplan.safety.certificate import Certificate, certify
from cfplan.safety.limits import Limits, PlanLimits
from cfplan.safety.space import check_space, inside
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.joint import Joint, joint_at
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import Trajectory

# Nominal times of the first segment that are tried, in its own: where s goes on as it was, where it is time, and behind
# what is still flown of the path left, for so long, s. Of 1,396 times that all ahead was dropped a way was found for
# 1,388: straight on for 1,202, by guides from the joint on for 129 of the others.
FIRST_TIMES, FIRST_TIMES_TIMED, FIRST_TIMES_LATER = (0.7, 1.0, 1.4, 2.0, 3.0), (1.0, 1.4, 2.0), (1.0, 1.4, 2.0)
LATER = (0.1, 0.35)
GUIDES = (0.15, 0.3, 0.08, 0.5)  # m from waypoints, at which guides lie, in the order in which they are tried
GUIDES_IN_MOTION = (0.3, 0.1)  # m likewise; and nominal times of the first segment with them
FIRST_TIMES_GUIDED, FIRST_TIMES_GUIDED_LATER = (1.6, 2.5), (1.6,)
FIRST_TIMES_GUIDED_AT_LAST = (1.1, 1.6, 2.5)  # the longer ones swing below the floor where the vehicle sinks fast
NEAR = 0.05  # m from waypoint 1, nearer than which the path left is not left later
RATE = 1.0  # units of s a second, where it is time: about the speed in m/s
TRIES, MOST_TRIES = 5, 14  # paths of a kind that are planned, and of all
SLOWING, LEVEL_FOR = 1.5, 0.3  # m/s², and s before that, with which the vehicle slows down to a lower speed
STOPPING = 0.6  # s of the way left, on which a vehicle that stops comes to rest
OVERSHOOT = 0.2  # s, for which a vehicle that speeds up goes on to do so
ROOM = 0.005  # share of each limit that plans leave to whoever continues them
BETWEEN = 0.6  # of that, which limits may use up between points: so much less is done to the plan
LATE_HINT = "ask again; a computer with less to do answers sooner"
PLANNER = "expert"  # it keeps boundary states, and takes some 10 ms for 10 m
# Share of the usual intervals on which it is planned, where all ahead was dropped: such plans take 0.05 % longer, and
# are made in nine tenths of the time. Where waypoints stay, the grid is as fine as that of the path left: at their
# limits motions can often not be continued on another.
COARSER = 0.85
_NODES = 60  # where a path's time is estimated
KINDS = range(5)  # of path, in the order in which they are tried
ON_PATH_LEFT = (2, 3)  # kinds that go on along the path left first, where no waypoints of that stay


class NoWayError(InfeasibleError):
    """No path that was tried leads from the state of a joint through the waypoints; from a later one it may."""


class TooLateError(CfplanError):
    """What is planned cannot be flown from its joint any more; from a later one it may."""


@dataclass(slots=True)
class Ways:
    """Which kinds of path led on, and which did not, from a joint a little before; written as paths are tried.

    Those that go on along the path left are not among the failed: of these, two in five lead on from 0.03 s later.
    """

    found: tuple[int, int] | None = None
    failed: set[tuple[int, int]] = field(default_factory=set)
    searched: float = 0.0  # s that it took to find it
    kinds: Sequence[int] = KINDS  # that are tried, besides the way found

    def restrict_to(self, kinds: Sequence[int]) -> None:
        """Try these kinds alone from now on."""
        self.kinds = kinds
        if self.found is not None and self.found[0] not in kinds:
            self.found = None

    def kinds_behind(self, way: tuple[int, int]) -> Sequence[int]:
        """Return the kinds that are tried once that of a way has been."""
        return [kind for kind in self.kinds if kind > way[0]]


@dataclass(frozen=True, slots=True)
class Continuation:
    """A plan that begins in the state of a joint."""

    plan: Plan
    reached: tuple[float, ...]  # s on its path, of each waypoint


def continue_plan(
    trajectory: Trajectory,
    leave: float,
    waypoints: ArrayLike,
    limits: Limits,
    *,
    times: ArrayLike | None = None,
    yaw: YawMode = YawMode.FIXED,
    yaw_angle: float = 0.0,
    speed: float = math.inf,
    ways: Ways | None = None,
    too_late: Callable[[], bool] = lambda: False,
) -> Continuation:
    """Return a certified plan that leaves a trajectory at `leave`, s, and goes through waypoints, (K, 3) m, to rest.

    `times`, (K,) s, are the nominal times of the segments that end in each, where waypoints of the path left stay: what
    is left of it. In mode FIXED yaw turns to `yaw_angle`, rad, along the path. `speed`, m/s, is not to be exceeded once
    the vehicle has slowed down to it, gently. With what is known of `ways` from another joint the one found there is
    tried first, and those that failed are not tried.

    Raises:
        InputError: the waypoints are no waypoints, or the trajectory does not move then.
        InfeasibleError: a waypoint lies outside the space, or none of the paths tried can be flown from this state.
        TooLateError: once a way was found it was `too_late` to plan along it.
    """
    begun, ways = time.perf_counter(), Ways() if ways is None else ways
    joint = joint_at(trajectory, leave)
    points = check_continued(joint.derivatives, waypoints)[1][1:]
    check_waypoints(points, limits)
    known = scaled_limits(limits.airframe, limits.plan)
    failure, grid = "", COARSER if times is None else _grid_of(trajectory)
    begins = _begins(joint, trajectory, points, times)
    straight = _straight(begins, points, times)
    makers = (
        lambda: straight,
        lambda: _guided(begins[:1], points, FIRST_TIMES_GUIDED, GUIDES_IN_MOTION[:1]),
        lambda: [way for begin in begins[2:] for way in _ways(begin, points, FIRST_TIMES_LATER)],
        lambda: _guided(begins[2:], points, FIRST_TIMES_GUIDED_LATER, GUIDES_IN_MOTION),
        lambda: _guided(begins[:2], points, FIRST_TIMES_GUIDED_AT_LAST, GUIDES_IN_MOTION[1:]),
    )
    for number, way in islice(_sound(makers, limits, known, ways), MOST_TRIES):
        caps = _slowing_to(speed, way) if speed < limits.plan.speed else None
        task = _with_room(PlanningTask(
            way.path, limits.airframe, limits.plan, round(grid * default_nodes(way.path, PLANNER)), yaw, yaw_angle,
            start=way.start, speed_caps=caps,
        ))  # fmt: skip
        failure = _why_not(task.refusal or Solution(Status.NOT_CONVERGED, None))
        if number == ways.found or can_begin(task):
            is_new, ways.found, ways.searched = number != ways.found, number, time.perf_counter() - begun
            if is_new and too_late():
                raise TooLateError("no way has been found in time", where="request", hint=LATE_HINT)
            found = _solve(task, limits, caps)
            if not isinstance(found, str):
                check_endurance(found.trajectory.duration, limits)
                return Continuation(_plan(found, task, limits, time.perf_counter() - begun), way.reached)
            failure, ways.found = found, None  # not from here, or not as slowly
        if number[0] not in ON_PATH_LEFT:
            ways.failed.add(number)
    failure = failure or _unsound(_made(straight)[0][1].path, limits)
    speed = float(np.linalg.norm(trajectory.at(leave).velocity))
    away = float(np.linalg.norm(points[0] - joint.derivatives[0]))
    rest = trajectory.at(min(leave + STOPPING, trajectory.duration)).position
    raise NoWayError(
        f"from {speed:.2f} m/s no way leads through waypoint 1, {away:.2f} m away: {failure}",
        where="waypoint 1",
        hint=f"give a waypoint farther on than {coordinates(rest, '.2f')} m, where it could rest, or stop first",
    )


def path_from_rest(points: ArrayLike, limits: Limits) -> tuple[Path, tuple[float, ...]]:
    """Return a path through points, (K, 3) m, at rest at both ends, and the s of each but the first.

    It has guides where it would swing outside the space without. Raises InputError where they are no waypoints.
    """
    given = np.asarray(points, dtype=float)
    times = centripetal_times(given)
    plain = min_snap(given, times=times), tuple(np.cumsum(times).tolist())
    if not _unsound(plain[0], limits):
        return plain
    for away in GUIDES:
        guided, rows = with_guides(given, away)
        times = centripetal_times(guided)
        path = min_snap(guided, times=times)
        if not _unsound(path, limits):
            return path, tuple(np.cumsum(times)[rows[1:] - 1].tolist())
    return plain


def check_waypoints(points: NDArray, limits: Limits) -> None:
    """Raise InfeasibleError where one of the waypoints, (K, 3) m, lies outside the space."""
    beyond, face = limits.space.nearest(points)
    if not (good := inside(beyond) | np.isnan(beyond)).all():  # NaN is refused where the path is made
        at = int(np.argmin(good))
        raise InfeasibleError(
            f"{coordinates(points[at], '.3f')} m is {beyond[at]:.3f} m too {limits.space.too(face[at])}",
            where=f"waypoint {at + 1}",
            hint="keep waypoints inside the space less its margin",
        )


class _Way(NamedTuple):
    """A path on which to go on, the boundary state at its start, and the s of each waypoint."""

    path: Path
    start: BoundaryState
    reached: tuple[float, ...]


class _Begin(NamedTuple):
    """A place from which a path goes on, in some unit of s, and what is flown before that of the path left."""

    derivatives: NDArray  # (5, 3) γ to γ'''' there
    state: BoundaryState  # of the joint
    before: Path | None = None


_Maker = Callable[[], _Way] | None  # None where there is no such way here


def _begins(joint: Joint, trajectory: Trajectory, points: NDArray, times: ArrayLike | None) -> list[_Begin | None]:
    """Return the joint, the same where s is time, and each place later; None where there is none."""
    timed = joint.timed(trajectory, RATE)
    begins: list[_Begin | None] = [_Begin(joint.derivatives, joint.state), _Begin(timed.derivatives, timed.state)]
    for later in LATER:
        s = float(trajectory.s_at(min(joint.time + later, trajectory.duration)))
        place = trajectory.path.derivatives(np.array([s]))[:, :, 0]
        moves = joint.time + later < trajectory.duration and s > joint.s
        if times is None and moves and math.dist(place[0], points[0]) > NEAR:
            begins.append(_Begin(place, joint.state, trajectory.path.part(joint.s, s)))
        else:
            begins.append(None)
    return begins


def _straight(begins: Sequence[_Begin | None], points: NDArray, times: ArrayLike | None) -> list[_Maker]:
    """Return what makes the paths of least snap through the waypoints; first the rest of the path left, if it stays."""
    made: list[_Maker] = []
    if times is not None and begins[0] is not None:
        through = np.concatenate([begins[0].derivatives[:1], points])
        made.append(partial(_way, begins[0], through, check_times(through, times)))
    for begin, factors in zip(begins[:2], (FIRST_TIMES, FIRST_TIMES_TIMED), strict=True):
        made += _ways(begin, points, factors)
    return made


def _guided(
    begins: Sequence[_Begin | None], points: NDArray, factors: Sequence[float], guides: Sequence[float]
) -> list[_Maker]:
    """Return what makes paths that keep near the straight lines between waypoints, by guides so far, m, from these."""
    made: list[_Maker] = []
    for away in guides:
        for begin in begins:
            made += _ways(begin, points, factors, away)
    return made


def _ways(begin: _Begin | None, points: NDArray, factors: Sequence[float], guides: float | None = None) -> list[_Maker]:
    """Return what makes paths whose first segments take these shares of their time, with guides so far, m, or none."""
    if begin is None:
        return [None] * len(factors)
    through, rows = np.concatenate([begin.derivatives[:1], points]), None
    if guides is not None:
        through, at = with_guides(through, guides, first_too=False)
        rows = [row - 1 for row in at[1:]]
    times = centripetal_times(through)
    ahead = [np.concatenate([[factor * times[0]], times[1:]]) for factor in factors]
    return [partial(_way, begin, through, each, rows) for each in ahead]


def _way(begin: _Begin, points: NDArray, times: NDArray, rows: Sequence[int] | None = None) -> _Way:
    """Return the path through points, first that where it begins; of the others those of the `rows`, or all, are
    waypoints.
    """
    path, reached = continued_through(begin.derivatives, points, times), np.cumsum(times)
    if begin.before is not None:
        path, reached = begin.before.followed_by(path), reached + begin.before.end
    return _Way(path, begin.state, tuple((reached if rows is None else reached[list(rows)]).tolist()))


def _made(makers: Sequence[_Maker], without: Container[int] = ()) -> list[tuple[int, _Way]]:
    """Return the ways that there are, and their numbers."""
    return [(k, maker()) for k, maker in enumerate(makers) if maker is not None and k not in without]


def _sound(
    kinds: Sequence[Callable[[], list[_Maker]]], limits: Limits, known: ScaledLimits, ways: Ways
) -> Iterator[tuple[tuple[int, int], _Way]]:
    """Yield ways inside the space that can be planned, TRIES of a kind at most, first the one that looks fastest.

    Each has a number. The one that was found elsewhere comes before all, and those that failed do not come.
    """
    first = ways.found
    if first is not None:
        makers = kinds[first[0]]()
        maker = makers[first[1]] if first[1] < len(makers) else None
        if maker is not None and not _unsound((way := maker()).path, limits):
            yield first, way
    for kind in ways.kinds:
        tried = {k for at, k in ways.failed | ({first} if first else set()) if at == kind}
        fastest_first = sorted(_made(kinds[kind](), tried), key=lambda each: _least_time(each[1].path, known))
        sound = (((kind, k), way) for k, way in fastest_first if not _unsound(way.path, limits))
        yield from islice(sound, TRIES)


def _grid_of(trajectory: Trajectory) -> float:
    """Return the share of the usual intervals on which a trajectory was planned."""
    own = (len(trajectory.profile.s) - 1) / default_nodes(trajectory.path, PLANNER)
    return min(max(own, COARSER), 1.0)


def _unsound(path: Path, limits: Limits) -> str:
    """Return why a path cannot be flown at any speed; empty where it can."""
    try:
        check_space(path, limits.space)
        path.check()
    except CfplanError as error:
        return error.what
    return ""


def _slowing_to(speed: float, way: _Way) -> SpeedCaps:
    """Return caps of speed along a path, that fall from what the vehicle has at its start."""
    s = np.linspace(0.0, way.path.end, 4 * default_nodes(way.path, PLANNER) + 1)
    moving = np.linalg.norm(way.path(s, 1), axis=1)
    length = np.append(0.0, np.cumsum((moving[1:] + moving[:-1]) / 2.0 * np.diff(s)))
    first = moving[0] * way.start.h**0.5
    gaining = moving[0] * way.start.dh / 2.0
    if moving[0] > 0.0:  # else it begins at rest, where γ' and γ'' are 0
        gaining += way.start.h * float(way.path(0.0, 1) @ way.path(0.0, 2)) / moving[0]
    highest = first + 0.1 + OVERSHOOT * max(gaining, 0.0)
    falling = np.sqrt(np.maximum(highest**2 - 2.0 * SLOWING * np.maximum(length - LEVEL_FOR * first, 0.0), 0.0))
    return SpeedCaps.of(s, np.maximum(falling, speed))


def _least_time(path: Path, known: ScaledLimits) -> float:
    """Return about how long a path takes at least, s, by what its derivatives allow place by place."""
    with np.errstate(all="ignore"):  # paths that stand still somewhere are refused once it is their turn
        least = known.time * float(np.exp(-node_features(path, _NODES, known, None)[:, REFERENCE]).sum())
    return least if math.isfinite(least) else math.inf


def with_room(limits: PlanLimits, airframe: Airframe, room: float = ROOM) -> PlanLimits:
    """Return limits that leave a share `room` of each to whoever continues the plan.

    A state just at a limit can hardly be continued: what follows is all but decided, and exceeds it by rounding.
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


class _Found(NamedTuple):
    trajectory: Trajectory
    certificate: Certificate
    joints: tuple[float, ...]


def _with_room(task: PlanningTask) -> PlanningTask:
    """Return the task with limits and speed caps that leave room, if its start state allows."""
    limits, caps = with_room(task.limits, task.airframe), task.speed_caps
    with_less = replace(task, limits=limits, speed_caps=caps and caps.scaled(1.0 - ROOM))
    return with_less if with_less.refusal is None else task


def _solve(task: PlanningTask, limits: Limits, caps: SpeedCaps | None) -> _Found | str:
    """Return a trajectory certified against the limits and `caps`, to which the task leaves room; or why not."""
    leaves_room = task.limits is not limits.plan
    solution = plan_early(task, BETWEEN * ROOM) if leaves_room else plan_early(task)
    if solution.profile is None:
        return _why_not(solution)
    trajectory = Trajectory(task.path, solution.profile, task.airframe)
    certificate = certify(trajectory, limits.plan, limits.space, caps)
    if not certificate.passed:
        return f"the plan exceeds the limit on {certificate.worst.name} by {certificate.worst.share - 1.0:.2%}"
    return _Found(trajectory, certificate, solution.joints)


def _why_not(solution: Solution) -> str:
    return f"{solution.status} ({' '.join(solution.reason.split())})" if solution.reason else str(solution.status)


def _plan(found: _Found, task: PlanningTask, limits: Limits, seconds: float) -> Plan:
    return Plan(
        path=task.path,
        airframe=task.airframe,
        limits=limits,
        trajectory=found.trajectory,
        certificate=found.certificate,
        planner=PLANNER,
        nodes=task.nodes,
        repair_speed_factor=1.0,
        speed_factor=1.0,
        seconds=seconds,
        notes=(),
        joints=found.joints,
    )
