"""Coordinate a fleet: start delays and clock rates with which certified plans keep their distance on their own paths.

Vehicles get the fastest clock one after another, each among those before it. The best order is unknown, so several are
tried: the longest flight first; then with the vehicle that was stuck, or ended last, moved to the front; then others.
Each order is sketched first, without planning again. The first one that costs hardly any time is planned at once; if
that fails, the search goes on, and at its end all sketches are planned, the fastest first.
A clock that only waits at the start is exact. One that slows later becomes speed caps, under which the path is planned
again, so that all limits hold; the result is compared with the other flights again.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InfeasibleError
from cfplan.geometry.random_paths import generator
from cfplan.planning.fleet.clocks import CELL, TICK, Stuck, VehicleClock, cells_of, fastest_clock
from cfplan.planning.fleet.hazards import Hazards
from cfplan.planning.fleet.lost import Loss, LossModel
from cfplan.planning.fleet.members import FleetMember, places
from cfplan.planning.fleet.separation import STOP, Separation, Stops, separations, stop_separations
from cfplan.planning.plan_result import Plan
from cfplan.planning.repair import under_caps
from cfplan.safety.speed_caps import SpeedCaps, allowed_speed
from cfplan.vehicle.trajectory import Trajectory

ORDERS = 60  # that are tried, at most
MADE = 12  # of these, whose plans are slowed and compared; the soonest first
SLACKS = (0.02, 0.05, 0.1)  # m added to the distance in the search, tried until the certificate passes
_OFF_PATH_SLACKS = (0.2, 0.35)  # m, tried in addition for vehicles that leave their paths to stop
_BETWEEN_SKEWS = 0.03  # s, largest spacing within the skew in the search
_LEAST_SPEED = 0.05  # m/s, of caps
_PLACES = 0.02  # s of a plan between the places of its caps


Finish = Callable[[Plan], Plan]  # finishes a plan that was made again; raises InfeasibleError


class Blocked(NamedTuple):
    """Why no order was found: where one vehicle is blocked by another."""

    pair: tuple[str, str]
    places: tuple[tuple[float, float], tuple[float, float]]  # m, x and y, of each of the pair
    time: float  # s after the fleet's start

    def __str__(self) -> str:
        a, b = self.pair
        x, y = self.places[0]
        return f"{b} blocks {a} at ({x:.2f}, {y:.2f}) m, {self.time:.2f} s after the start"


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """A flight that a clock must avoid."""

    number: int
    base: Trajectory  # the plan before coordination
    clock: VehicleClock | None  # its sketched clock
    member: FleetMember | None = None  # the planned flight

    @property
    def end(self) -> float:
        if self.member is not None:
            return self.member.end
        assert self.clock is not None
        return TICK * (len(self.clock.own) - 1)

    @property
    def delay(self) -> float:
        if self.member is not None:
            return self.member.delay
        assert self.clock is not None
        return self.clock.delay

    def own(self, times: NDArray) -> NDArray:
        """Return the own time of the plan before coordination at common times, s."""
        if self.member is not None:
            made = self.member.plan.trajectory
            return self.base.time_at(made.s_at((times - self.member.delay).ravel())).reshape(times.shape)
        assert self.clock is not None
        return np.asarray(np.interp(times, TICK * np.arange(len(self.clock.own)), CELL * self.clock.own))

    def columns(self, times: NDArray) -> NDArray:
        """Return x and y at common times, (..., 2) m."""
        return places(self.base, self.own(times).ravel()).reshape(*times.shape, 2)


def coordinate(
    members: Sequence[FleetMember],
    apart: float,
    skew: float,
    finish: Finish,
    lost: LossModel | None = None,
    stops: Callable[[Plan], Stops] | None = None,
) -> tuple[FleetMember, ...] | Blocked:
    """Return the members with delays and slower plans, whose columns stay `apart`, m, for clocks `skew`, s, apart.

    `finish` is applied to each slower plan before it is compared with others. With a model of lost vehicles, the others
    also keep away from these. `stops` are those of vehicles that leave their paths to stop.
    """
    hazards = None if lost is None else Hazards.of(members, lost, skew)
    search = _Search(tuple(members), apart, skew, _distance_at_rest(members), finish, lost, hazards, stops)
    found: list[tuple[float, tuple[int, ...]]] = []
    blocked: Blocked | None = None
    longest = max(member.plan.trajectory.duration for member in members)
    names = [member.name for member in members]
    orders = _Orders([member.plan.trajectory.duration for member in members])
    for order in orders:
        tracks = search.sketch(order)
        last = None if isinstance(tracks, Blocked) else max(tracks, key=lambda track: track.end)
        if last is not None and last.end > longest + 2 * TICK:
            found.append((last.end, order))
            orders.prefer(last.number)
            continue
        made = tracks if isinstance(tracks, Blocked) else search.make(order)
        if not isinstance(made, Blocked):
            return made
        blocked = blocked or made
        orders.prefer(names.index(made.pair[0]))
    for _, order in sorted(found)[:MADE]:
        made = search.make(order)
        if not isinstance(made, Blocked):
            return made
        blocked = blocked or made
    assert blocked is not None
    return blocked


class _Orders:
    """Orders to try, each once, the preferred ones first."""

    def __init__(self, durations: list[float]):
        self._next: tuple[int, ...] | None = tuple(np.argsort(-np.array(durations), kind="stable").tolist())
        self._tried: list[tuple[int, ...]] = []

    def __iter__(self) -> Iterator[tuple[int, ...]]:
        assert self._next is not None
        count, random = len(self._next), generator(0)
        while len(self._tried) < min(ORDERS, math.factorial(count)):
            order, self._next = self._next or tuple(random.permutation(count).tolist()), None
            if order not in self._tried:
                self._tried.append(order)
                yield order

    def prefer(self, first: int) -> None:
        """Try next the present order with a vehicle moved to the front."""
        self._next = (first, *(number for number in self._tried[-1] if number != first))


@dataclass(frozen=True, slots=True)
class _Search:
    """Search for the clocks of members in one order, with the distances that they must keep."""

    members: tuple[FleetMember, ...]
    apart: float  # m
    skew: float  # s
    at_rest: float  # m, between starts and between ends, which no clock changes
    finish: Finish
    lost: LossModel | None = None
    hazards: Hazards | None = None
    stops: Callable[[Plan], Stops] | None = None

    def sketch(self, order: tuple[int, ...]) -> list[_Track] | Blocked:
        """Return clocks in an order, without planning again."""
        tracks: list[_Track] = []
        for number in order:
            clock = self._clock(number, tracks, SLACKS[0])
            if isinstance(clock, Blocked):
                return clock
            tracks.append(_Track(number, self.members[number].plan.trajectory, clock))
        return tracks

    def make(self, order: tuple[int, ...]) -> tuple[FleetMember, ...] | Blocked:
        """Return the members with the clocks of an order, each planned again if it is slowed."""
        tracks: list[_Track] = []
        for number in order:
            made = self._track(number, tracks)
            if isinstance(made, Blocked):
                return made
            tracks.append(made)
        members = tuple(track.member for track in sorted(tracks, key=lambda track: track.number) if track.member)
        nearest = self._nearest_loss(members, range(len(members)))
        return members if nearest is None else _blocked_by(nearest, members)

    def _track(self, number: int, tracks: list[_Track]) -> _Track | Blocked:
        """Return the flight of a vehicle that keeps apart from the tracks of others."""
        member, others = self.members[number], [track.member for track in tracks if track.member]
        blocked: Blocked | None = None
        for slack in SLACKS if self.stops is None else (*SLACKS, *_OFF_PATH_SLACKS):
            clock = self._clock(number, tracks, slack)
            if isinstance(clock, Blocked):
                return blocked or clock
            try:
                made = _with_clock(member, clock, self.apart, self.finish)
            except InfeasibleError:  # too slow for a profile, or not safe at any speed
                slows = int(np.argmax((clock.rate > 0.0) & (clock.rate < 1.0)))
                blocked = self._blocked(number, Stuck(CELL * float(clock.own[slows]), TICK * slows), tracks)
                continue
            nearest = self._nearest(made, tracks)
            if nearest is not None and not nearest.keeps(self.apart):
                blocked = _blocked_by(nearest, (made, *others))
                continue
            near = [
                self._nearest_loss((made, track.member), (number, track.number)) for track in tracks if track.member
            ]
            lost = min((each for each in near if each), key=lambda each: each.distance, default=None)
            if lost is None:
                return _Track(number, member.plan.trajectory, None, made)
            blocked = _blocked_by(lost, (made, *others))
        assert blocked is not None
        return blocked

    def _nearest(self, made: FleetMember, tracks: list[_Track]) -> Separation | None:
        """Return the nearest approach to the tracks of others, also when all brake; None if there are none."""
        found = []
        for track in tracks:
            if track.member is not None:
                pair = made, track.member
                found.append(separations(pair, self.skew)[0])
                if self.stops is not None:
                    found.append(stop_separations(pair, [self.stops(each.plan) for each in pair], self.skew)[0])
        return min(found, key=lambda each: each.distance, default=None)

    def _clock(self, number: int, tracks: list[_Track], slack: float) -> VehicleClock | Blocked:
        """Return the fastest clock of a vehicle among the tracks of others."""
        trajectory = self.members[number].plan.trajectory
        own = places(trajectory, cells_of(trajectory.duration))
        goes_on = STOP + self.skew  # while all brake
        last = max((max(track.end, track.delay + goes_on) for track in tracks), default=0.0) + self.skew
        ticks = TICK * np.arange(int(np.ceil(last / TICK)) + 2)
        band = np.linspace(-self.skew, self.skew, 2 * int(np.ceil(self.skew / _BETWEEN_SKEWS)) + 1)
        others = np.zeros((len(tracks), len(ticks), len(band) + 1, 2))
        for row, track in zip(others, tracks, strict=True):
            row[:, :-1] = track.columns(ticks[:, None] + band)
            # It stays at its start if all brake before it begins.
            row[:, -1] = track.columns(np.where(ticks <= track.delay + goes_on + TICK, 0.0, ticks))
        keeps = min(self.apart + slack, max(self.at_rest, self.apart))
        hazard = np.zeros((len(ticks), len(own)), dtype=np.bool_)
        may_start = _may_start(own[0], others, keeps, int(np.ceil(goes_on / TICK)))
        if self.hazards is not None:
            for track in tracks:
                times = np.where(ticks < track.delay, ticks - track.delay, track.own(ticks))
                self.hazards.mark(hazard, may_start, (number, track.number), times, slack)
        clock = fastest_clock(own, others, keeps, hazard, may_start)
        return clock if isinstance(clock, VehicleClock) else self._blocked(number, clock, tracks)

    def _nearest_loss(self, members: Sequence[FleetMember], numbers: Sequence[int]) -> Loss | None:
        """Return the lost vehicle that comes nearest to another, if it comes too near."""
        if self.lost is None:
            return None
        nearest = self.lost.losses(members, numbers, self.skew)[0]
        return None if nearest.keeps(self.lost.clearance) else nearest

    def _blocked(self, number: int, stuck: Stuck, tracks: list[_Track]) -> Blocked:
        """Return where a vehicle is stuck, and the other vehicle that is nearest to its next position."""
        trajectory = self.members[number].plan.trajectory
        here, ahead = places(trajectory, np.array([stuck.own, stuck.own + TICK]))
        others = [track.columns(np.array([stuck.time]))[0] for track in tracks]
        nearest = int(np.argmin([np.linalg.norm(other - ahead) for other in others]))
        pair = self.members[number].name, self.members[tracks[nearest].number].name
        (x, y), (other_x, other_y) = here.tolist(), others[nearest].tolist()
        return Blocked(pair, ((x, y), (other_x, other_y)), stuck.time)


def _may_start(start: NDArray, others: NDArray, keeps: float, goes_on: int) -> NDArray:
    """Return whether a vehicle may start at each tick, (T,) bool: no other comes near its start within some ticks.

    If all brake before it starts, it stays there, while the others, (K, T, W, 2) m, go on for `goes_on` ticks.
    """
    near = ~(np.linalg.norm(others - start, axis=-1) >= keeps).all(axis=(0, 2))
    then = np.minimum(np.arange(len(near))[:, None] + np.arange(goes_on + 1), len(near) - 1)
    return np.asarray(~near[then].any(axis=1))


def _distance_at_rest(members: Sequence[FleetMember]) -> float:
    """Return the least distance, m, from start to start or from end to end."""
    ends = np.stack([member.plan.path(np.array([0.0, member.plan.path.end]))[:, :2] for member in members])
    return min((float(np.linalg.norm(a - b, axis=1).min()) for a, b in itertools.combinations(ends, 2)), default=np.inf)


def _blocked_by(near: Separation | Loss, members: Sequence[FleetMember]) -> Blocked:
    """Return which pair comes too near, as the reason why a vehicle gets no farther."""
    at = {member.name: member.columns(np.array([near.time]))[0].tolist() for member in members}
    (x, y), (other_x, other_y) = (at[name] for name in near.pair)
    return Blocked(near.pair, ((x, y), (other_x, other_y)), near.time)


def _with_clock(member: FleetMember, clock: VehicleClock, apart: float, finish: Finish) -> FleetMember:
    """Return the member with a clock, planned again if the clock slows. Raises InfeasibleError."""
    if not clock.slows:
        return replace(member, delay=clock.delay)
    plan = member.plan
    trajectory, slower = plan.trajectory, plan.slowing
    own = np.linspace(0.0, trajectory.duration, int(np.ceil(trajectory.duration / _PLACES)) + 1)
    s = np.concatenate([[0.0], trajectory.s_at(own[1:-1]), [plan.path.end]])
    rate = clock.rate_at(own)
    speed = np.sqrt(trajectory.profile.at(s).h) * np.linalg.norm(plan.path(s, 1), axis=1)
    allowed = allowed_speed(plan.limits.plan.speed, slower.caps if slower else None, s)
    caps = SpeedCaps.of(s, np.where(rate < 1.0, np.minimum(np.maximum(rate * speed, _LEAST_SPEED), allowed), allowed))
    reasons = dict.fromkeys((*(slower.reasons if slower else ()), f"staying {apart:.2f} m from the other vehicles"))
    return replace(member, plan=finish(under_caps(plan, plan, caps, tuple(reasons))), delay=clock.delay)
