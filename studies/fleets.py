"""Coordinate random fleets in the shipped room, with and without regard to lost vehicles, and check them densely.

Each fleet flies the fastest paths through random waypoints, each planned alone first. A fleet of fewer vehicles
has the first paths of the largest one of the same seed. The checks share no code with the certificates: they compare
the states of the plans over the skew, and the stops from every setpoint when all brake, and fly drawn vehicles without
link and poses beside the others, which brake.
"""

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError
from cfplan.flight.setpoints.encoding import RATE, EncodedFlight
from cfplan.flight.setpoints.stops import stop_motion
from cfplan.geometry.path_file import path_through
from cfplan.geometry.random_paths import generator, random_waypoints
from cfplan.planning.fleet.coordination import Blocked, coordinate
from cfplan.planning.fleet.fleet_file import LEAST_APART, SKEW, FleetFile, FleetVehicle
from cfplan.planning.fleet.lost import NOTICED
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.plan_result import Plan
from cfplan.preparation.plan_fleet import coordinate_fleet, loss_model
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight, give_way, plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits import Limits
from cfplan.simulation.draws import draw_vehicles
from cfplan.simulation.dry_run import fly_drawn, rehearsed_flight
from studies.drawn_paths import WAYPOINTS
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.reductions import among, count, mean, quantile, smallest
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

_FROM_MARGIN = 0.05  # m that waypoints keep from the margin of the walls, as paths swing out between them
_WITHOUT_BUDGET = FlightOptions(budget=math.inf)  # so that plans do not depend on the computer's load
_LONGEST = 4.0  # s from the last setpoint until every vehicle lies on the floor


@dataclass(frozen=True, slots=True)
class Settings:
    """The fleets to coordinate, and how densely lost vehicles are flown."""

    fleets: int = option(200, "Number of fleets of each size.", least=1)
    lost: int = option(20, "Number of these that also avoid lost vehicles.", least=0)
    sizes: tuple[int, ...] = option((2, 3, 4, 6), "Number of vehicles of a fleet.", least=2)
    apart: float = option(LEAST_APART, "Distance that vehicles keep, m.", least=LEAST_APART)
    moments: int = option(12, "Moments at which each vehicle is lost in the check.", least=1)
    seed: int = option(0, "Seed of the first fleet.", least=0)


@dataclass(slots=True)
class CoordinatedFleet:
    """A fleet, coordinated without and with regard to lost vehicles; NaN where that was not possible."""

    name: str
    vehicles: int
    planning: float = 0.0  # s of processor time, of the plans alone
    makespan: float = math.nan  # of the slowest vehicle alone, without regard to lost vehicles
    replanned: bool = False  # whether a path leads around another vehicle
    seconds: float = 0.0  # s of processor time, of coordination, replanning and certificate; also if refused
    nearest: float = math.nan  # m, of a pair, on their paths and when all brake, by the check
    regards_lost: bool = False  # whether it was also coordinated with regard to lost vehicles
    lost_makespan: float = math.nan
    lost_seconds: float = math.nan
    lost_nearest: float = math.nan  # m, of a lost vehicle and another, by the check

    @property
    def solved(self) -> bool:
        """Return whether the vehicles keep apart."""
        return bool(np.isfinite(self.makespan))

    @property
    def keeps_lost(self) -> bool:
        """Return whether they also keep away from a lost one."""
        return bool(np.isfinite(self.lost_makespan))


COLUMNS = (
    Column("vehicles", "vehicles", "", "d"),
    Column("fleets", "fleets", value=count()),
    Column("solved", "keep apart", of="fleets", value=count("solved")),
    Column("makespan", "makespan", "", ".3f", meaning="mean; over the slowest vehicle alone",
           value=among("solved", mean("makespan"))),
    Column("replanned", "replanned", of="solved", meaning="fleets with a path that leads around another vehicle",
           value=count("replanned")),
    Column("planning", "planning", "s", ".1f", meaning="processor time of the plans alone, median",
           value=quantile("planning", 0.5)),
    Column("seconds", "coordination, median", "s", ".1f", meaning="processor time, with replanning and certificate, of "
           "refused fleets too", value=quantile("seconds", 0.5)),
    Column("seconds_95", "coordination, 95 %", "s", ".1f", value=quantile("seconds", 0.95)),
    Column("nearest", "nearest", "m", ".3f", meaning="of all pairs, also when all brake, by the dense check",
           value=among("solved", smallest("nearest"))),
    Column("regards_lost", "lost vehicles", meaning="fleets that are also coordinated to keep clear of a lost vehicle, "
           "on the paths first planned", value=count("regards_lost")),
    Column("keeps_lost", "keep clear of the lost", of="regards_lost", value=count("keeps_lost")),
    Column("lost_makespan", "makespan then", "", ".2f", meaning="mean; over the slowest vehicle alone",
           value=among("keeps_lost", mean("lost_makespan"))),
    Column("lost_seconds", "coordination then", "s", ".1f", value=among("regards_lost", quantile("lost_seconds", 0.5))),
    Column("lost_nearest", "nearest lost", "m", ".3f", meaning="of drawn vehicles without link and poses to the others "
           "that brake, soonest, latest and between, on clocks that are early or late",
           value=among("keeps_lost", smallest("lost_nearest"))),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return one case per seed: its fleets of all sizes."""
    seeds = range(settings.seed, settings.seed + settings.fleets)
    cases = {f"fleet {seed}": (seed, settings, number < settings.lost) for number, seed in enumerate(seeds)}
    return Work(cases, partial(measure, limits=limits_for(Path())), CoordinatedFleet)


def measure(case: tuple[int, Settings, bool], limits: Limits) -> list[CoordinatedFleet]:
    """Plan the paths of a seed alone, and coordinate fleets of the first of them."""
    seed, settings, with_lost = case
    alone = list(itertools.islice(_planned_vehicles(seed, settings.apart, limits), max(settings.sizes)))
    rows = []
    for size in settings.sizes:
        fleet = FleetFile(f"seed {seed}", tuple(each.vehicle for each in alone[:size]), settings.apart, SKEW)
        members = [each.member for each in alone[:size]]
        row = _coordinated(fleet, members, limits)
        row.planning = sum(each.seconds for each in alone[:size])
        if with_lost:
            _avoid_lost(row, fleet, members, limits, settings.moments, seed)
        rows.append(row)
    return rows


class _PlannedVehicle(NamedTuple):
    vehicle: FleetVehicle
    member: FleetMember
    seconds: float  # of processor time, of its plan


def _planned_vehicles(seed: int, apart: float, limits: Limits) -> Iterator[_PlannedVehicle]:
    """Yield vehicles on the fastest paths through random waypoints, whose starts and whose ends are apart."""
    distance = limits.space.margin + _FROM_MARGIN
    box = np.array([limits.space.low, limits.space.high]) + np.array([[distance], [-distance]])
    ends: list[NDArray] = []
    for number in itertools.count():
        with suppress(CfplanError):  # the path leaves the space between its waypoints, or has no flight
            path_file = path_through(random_waypoints(np.random.SeedSequence([seed, number]), box, WAYPOINTS))
            both = path_file.waypoints[[0, -1], :2]
            if all((np.linalg.norm(both - other, axis=1) >= apart).all() for other in ends):
                begun = time.process_time()
                planned = plan_flight(path_file, limits, _WITHOUT_BUDGET).plan
                ends.append(both)
                name = f"v{len(ends)}"
                seconds = time.process_time() - begun
                yield _PlannedVehicle(FleetVehicle(name, path_file), FleetMember(name, planned), seconds)


def _coordinated(fleet: FleetFile, alone: Sequence[FleetMember], limits: Limits) -> CoordinatedFleet:
    """Coordinate a fleet without regard to lost vehicles."""
    row, begun = CoordinatedFleet(fleet.name, len(alone)), time.process_time()
    with suppress(CfplanError):
        made = coordinate_fleet(fleet, alone, limits, None, options=_WITHOUT_BUDGET)
        row.makespan = made.end / made.alone
        row.replanned = bool(made.detours)
    row.seconds = time.process_time() - begun
    if row.solved:
        row.nearest = _nearest_pair(made.members, limits)
    return row


def _avoid_lost(
    row: CoordinatedFleet, fleet: FleetFile, alone: Sequence[FleetMember], limits: Limits, moments: int, seed: int
) -> None:
    """Coordinate the fleet of a row so that the vehicles also keep clear of a lost one."""
    model = loss_model(fleet, limits)
    row.regards_lost, begun = True, time.process_time()
    clear = coordinate(alone, fleet.apart, fleet.skew, _given_way, model)
    row.lost_seconds = time.process_time() - begun
    if not isinstance(clear, Blocked):
        row.lost_makespan = max(each.end for each in clear) / max(each.end for each in alone)
        row.lost_nearest = _nearest_lost(clear, limits, moments, seed)


def _given_way(planned: Plan) -> Plan:
    return give_way(planned)[0]


def _distance(a: FleetMember, b: FleetMember) -> float:
    """Return the least distance of two vehicles, m, by the states of their plans at every 4 ms and seven skews."""
    times = np.arange(0.0, max(a.end, b.end) + 0.1, 0.004)
    of_a = _positions(a, times)
    skews = np.linspace(-SKEW, SKEW, 7)
    return min(float(np.linalg.norm(of_a - _positions(b, times + late), axis=1).min()) for late in skews)


def _nearest_pair(members: Sequence[FleetMember], limits: Limits) -> float:
    """Return the least distance of two vehicles on their paths, and when all brake at one moment, m."""
    least = min(_distance(a, b) for a, b in itertools.combinations(members, 2))
    ticks = np.arange(round((max(member.end for member in members) + 0.1) * RATE))
    stops = [_stops(member, ticks, limits) for member in members]
    for a, b in itertools.combinations(stops, 2):
        for late in range(round(SKEW * RATE) + 1):
            early = len(ticks) - late
            for one, other in ((a[:early], b[late:]), (b[:early], a[late:])):
                least = min(least, float(np.linalg.norm(one - other, axis=2).min()))
    return least


def _stops(member: FleetMember, ticks: NDArray, limits: Limits) -> NDArray:
    """Return the places of stops that begin at ticks of the common clock, (N, M, 2) m; before its start it waits."""
    motion = encode_flight(PlannedFlight(member.name, member.plan, limits)).motion
    rows = ticks - round(member.delay * RATE)
    stops, _ = stop_motion(motion, np.clip(rows, 0, len(motion.position) - 1), RATE)
    places = stops.position.reshape(len(ticks), -1, 3)[..., :2]
    return np.where((rows < 0)[:, None, None], motion.position[0, :2], places)


def _positions(member: FleetMember, times: NDArray) -> NDArray:
    trajectory = member.plan.trajectory
    return np.asarray(trajectory.at(np.clip(times - member.delay, 0.0, trajectory.duration)).position[:, :2])


def _nearest_lost(members: Sequence[FleetMember], limits: Limits, moments: int, seed: int) -> float:
    """Lose link and poses of each vehicle at some moments, one drawn vehicle each; return the nearest to another, m."""
    encoded = [encode_flight(PlannedFlight(each.name, each.plan, limits)) for each in members]
    random, least = generator(seed), np.inf
    for i, lost in enumerate(members):
        flight = rehearsed_flight(encoded[i], lost.plan.trajectory)
        draws = draw_vehicles(limits.airframe, limits.pose, moments)
        for moment, draw in zip(np.linspace(0.0, lost.plan.trajectory.duration, moments), draws, strict=True):
            own = round(float(moment) * RATE) / RATE
            flown = fly_drawn(replace(flight, duration=own + _LONGEST), draw, limits, own)
            way = flown.position[round(1000 * own) :: 10]
            down = np.flatnonzero(way[:, 2] <= limits.space.low[2])
            way = way[: down[0] + 1, :2] if len(down) else way[:, :2]
            for j, other in enumerate(members):
                if j != i:
                    losses = (lost.delay + own,) if own else (-NOTICED[1] - 1.0, lost.delay)  # also before the start
                    ways = itertools.product((*NOTICED, random.uniform(*NOTICED)), (-SKEW, 0.0, SKEW), losses)
                    for begins, late, loss in ways:
                        least = min(least, _least(way, _braking(other, encoded[j], loss + late, begins)))
    return float(least)


def _braking(member: FleetMember, encoded: EncodedFlight, loss: float, begins: float) -> NDArray:
    """Return the places, (M, 2) m at each setpoint after a loss, of a vehicle that begins to brake then."""
    motion = encoded.motion
    own = np.round((loss - member.delay) * RATE) + np.arange(round(begins * RATE) + 1)
    if own[-1] < 0:  # it waits at its start
        return motion.position[:1, :2]
    rows = np.clip(own, 0, len(motion.position) - 1).astype(int)
    stop, _ = stop_motion(motion, rows[-1:], RATE)
    return np.concatenate([motion.position[rows[:-1]], stop.position])[:, :2]


def _least(way: NDArray, others: NDArray) -> float:
    """Return the least distance while the first is in the air, and from where it lies to where the other rests, m."""
    ticks = np.arange(max(len(way), len(others)))
    away = np.linalg.norm(way[np.minimum(ticks, len(way) - 1)] - others[np.minimum(ticks, len(others) - 1)], axis=1)
    return float(min(away[: len(way)].min(), away[-1]))


def tables(settings: Settings, rows: list[Any]) -> Iterator[Table]:
    """Yield a table with one row per number of vehicles."""
    yield table("fleets", f"Random fleets, {settings.apart:g} m apart", COLUMNS, rows, by=("vehicles",))


STUDY = Study(Settings, work, tables, "-o results/fleets.json")
