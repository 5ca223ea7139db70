"""Coordinate a fleet: start delays and clock rates with which certified plans keep apart on their own paths.

One vehicle after another gets the fastest clock among those before it. Which order is best is not known, so several are
tried: the longest flight first; then with the one that was stuck, or that ended last, moved to the front; then others.
A clock that only waits at the start is exact. One that slows on the way becomes speed caps, under which the path is
planned again, so that all limits hold; what comes of it is measured against the others, not assumed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InfeasibleError
from cfplan.geometry.random_paths import generator
from cfplan.planning.fleet.clocks import CELL, LEVELS, TICK, Clock, Others, Stuck, cells_of, fastest_clock
from cfplan.planning.fleet.hazards import STRIDE, LossModel, hazard_map
from cfplan.planning.fleet.members import FleetMember, places
from cfplan.planning.fleet.separation import pair_separation
from cfplan.planning.under_caps import under_caps
from cfplan.safety.speed_caps import SpeedCaps, allowed_speed
from cfplan.vehicle.trajectory import Trajectory

ORDERS, TRIALS = 24, 6  # tried roughly, and of these made, the fastest first
SLACKS = (0.02, 0.05, 0.1)  # m added to the distance that a search keeps, until what comes of it keeps the distance
_BETWEEN_SKEWS = 0.03  # s, at most, between the moments of the skew at which a search compares
_LEAST_SPEED = 0.05  # m/s, of caps
_PLACES = 0.02  # s of a plan from one place of its caps to the next


class Blocked(NamedTuple):
    """Why no order was found: where one vehicle gets no farther for another."""

    pair: tuple[str, str]
    place: tuple[float, float]  # m, x and y, of the first
    time: float  # s after the fleet's start

    def __str__(self) -> str:
        a, b = self.pair
        x, y = self.place
        return f"{a} gets no farther than ({x:.2f}, {y:.2f}) m at {self.time:.2f} s for {b}"


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """A flight among which a clock is sought."""

    number: int
    base: Trajectory  # the plan before coordination
    clock: Clock | None  # its clock, as sketched
    member: FleetMember | None = None  # the flight, as made

    @property
    def end(self) -> float:
        if self.member is not None:
            return self.member.end
        assert self.clock is not None
        return TICK * (len(self.clock.own) - 1)

    def own(self, times: NDArray) -> NDArray:
        """Return the own time of the plan before coordination at times of all, s."""
        if self.member is not None:
            made = self.member.plan.trajectory
            return self.base.time_at(made.s_at((times - self.member.delay).ravel())).reshape(times.shape)
        assert self.clock is not None
        return np.asarray(np.interp(times, TICK * np.arange(len(self.clock.own)), CELL * self.clock.own))

    def columns(self, times: NDArray) -> NDArray:
        """Return x and y at times of all, (..., 2) m."""
        return places(self.base, self.own(times).ravel()).reshape(*times.shape, 2)


def coordinate(
    members: Sequence[FleetMember], apart: float, skew: float, loss: LossModel | None = None
) -> tuple[FleetMember, ...] | Blocked:
    """Return the members with delays and slower plans, whose columns stay `apart`, m, for clocks `skew`, s, apart.

    With `loss`, clocks are sought with which vehicles can get out of the way of a lost one.
    """
    found: list[tuple[float, tuple[int, ...]]] = []
    blocked: Blocked | None = None
    longest = max(member.plan.trajectory.duration for member in members)
    orders = _Orders([member.plan.trajectory.duration for member in members])
    for order in orders:
        tracks = _sketched(members, order, apart, skew, loss)
        if isinstance(tracks, Blocked):
            blocked = blocked or tracks
            orders.prefer(next(n for n in order if members[n].name == tracks.pair[0]))
            continue
        last = max(tracks, key=lambda track: track.end)
        found.append((last.end, order))
        if last.end <= longest + 2 * TICK:
            break
        orders.prefer(last.number)
    for _, order in sorted(found)[:TRIALS]:
        made = _made(members, order, apart, skew, loss)
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
        for _ in range(4 * ORDERS):
            order, self._next = self._next or tuple(random.permutation(count).tolist()), None
            if order not in self._tried:
                self._tried.append(order)
                yield order
            if len(self._tried) == ORDERS:
                return

    def prefer(self, first: int) -> None:
        """Try next the present order with a vehicle moved to the front."""
        self._next = (first, *(number for number in self._tried[-1] if number != first))


def _sketched(
    members: Sequence[FleetMember], order: tuple[int, ...], apart: float, skew: float, loss: LossModel | None
) -> list[_Track] | Blocked:
    """Return clocks in an order, without planning again."""
    tracks: list[_Track] = []
    for number in order:
        clock = _clock(members, number, tracks, apart + SLACKS[0], skew, loss)
        if isinstance(clock, Blocked):
            return clock
        tracks.append(_Track(number, members[number].plan.trajectory, clock))
    return tracks


def _made(
    members: Sequence[FleetMember], order: tuple[int, ...], apart: float, skew: float, loss: LossModel | None
) -> tuple[FleetMember, ...] | Blocked:
    """Return the members with the clocks of an order, each planned again where it is slowed."""
    tracks: list[_Track] = []
    for number in order:
        member = members[number]
        for slack in SLACKS:
            clock = _clock(members, number, tracks, apart + slack, skew, loss)
            if isinstance(clock, Blocked):
                return clock
            others = [track.member for track in tracks if track.member is not None]
            made = _with_clock(member, clock, apart)
            nearest = [pair_separation(made, other, skew) for other in others] if made else []
            if made and all(each.keeps(apart) for each in nearest):
                tracks.append(_Track(number, member.plan.trajectory, None, made))
                break
        else:
            if made is None or not nearest:
                return Blocked((member.name, members[order[0]].name), (0.0, 0.0), 0.0)
            worst = min(nearest, key=lambda each: each.distance)
            return Blocked(worst.pair, worst.place, worst.time)
    by_number = {track.number: track.member for track in tracks}
    return tuple(made for n in range(len(members)) if (made := by_number[n]) is not None)


def _clock(
    members: Sequence[FleetMember],
    number: int,
    tracks: list[_Track],
    apart: float,
    skew: float,
    loss: LossModel | None,
) -> Clock | Blocked:
    """Return the fastest clock of a vehicle among the tracks of others."""
    member = members[number]
    trajectory = member.plan.trajectory
    own = places(trajectory, cells_of(trajectory.duration))
    if not tracks:
        alone = Others(np.zeros((0, 1, 1, 2)), np.zeros((1, 1, LEVELS + 1), dtype=bool), STRIDE)
        clock = fastest_clock(own, alone, apart)
        assert isinstance(clock, Clock)
        return clock
    ticks = TICK * np.arange(int(np.ceil((max(track.end for track in tracks) + skew) / TICK)) + 2)
    band = np.linspace(-skew, skew, 2 * int(np.ceil(skew / _BETWEEN_SKEWS)) + 1)
    columns = np.stack([track.columns(ticks[:, None] + band) for track in tracks])
    hazard = np.zeros((1, 1, LEVELS + 1), dtype=bool)
    if loss is not None:
        hazard = _hazard(own, number, tracks, ticks[::STRIDE], loss)
    clock = fastest_clock(own, Others(columns, hazard, STRIDE), apart)
    if isinstance(clock, Clock):
        return clock
    return _blocked(member, clock, own, tracks, members)


def _hazard(own: NDArray, number: int, tracks: list[_Track], times: NDArray, loss: LossModel) -> NDArray:
    """Return the hazard map of a vehicle at times of all, (T,) s."""
    swept, passing = [], []
    for track in tracks:
        tube = loss.tubes[track.number]
        rows = np.minimum(np.round(track.own(times) / loss.every).astype(int), len(tube) - 1)
        swept.append(tube[rows])
        passing.append(track.columns(times[:, None, None] + loss.braking))
    rates = np.arange(LEVELS + 1) / LEVELS
    return hazard_map(own, CELL, loss.tubes[number], np.stack(swept), np.stack(passing), loss, rates)


def _blocked(
    member: FleetMember, stuck: Stuck, own: NDArray, tracks: list[_Track], members: Sequence[FleetMember]
) -> Blocked:
    here = own[round(stuck.own / CELL)]
    ahead = own[min(round(stuck.own / CELL) + LEVELS, len(own) - 1)]
    then = np.array([stuck.time])
    nearest = min(tracks, key=lambda track: float(np.linalg.norm(track.columns(then)[0] - ahead)))
    return Blocked((member.name, members[nearest.number].name), (float(here[0]), float(here[1])), stuck.time)


def _with_clock(member: FleetMember, clock: Clock, apart: float) -> FleetMember | None:
    """Return the member with a clock, planned again where that is slow; None where that is not possible."""
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
    try:
        return replace(member, plan=under_caps(plan, plan, caps, tuple(reasons)), delay=clock.delay)
    except InfeasibleError:
        return None
