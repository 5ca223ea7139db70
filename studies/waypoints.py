"""Choose paths through sets of waypoints, and compare their flights with min-snap and with a point mass.

The sets are of many kinds, in the shipped room or in a larger hall. Each is also flown in a tight room, whose walls
leave 0.15 m around the box of the waypoints, and with every waypoint passed within a distance. Other rooms have
obstacles between the waypoints; there, plans also give way for link loss and stops, as flights do. Tracks with
published coordinates are flown in a space around them.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError
from cfplan.geometry.path_file import PathFile, path_through
from cfplan.geometry.waypoints import Within
from cfplan.planners.baselines.point_mass import point_mass_time
from cfplan.planning.path.choice import FastestPath, fastest_path
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan
from cfplan.preparation.plan_flight import give_way
from cfplan.safety.limits import Limits
from cfplan.safety.space import Space
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.reductions import among, count, largest, mean, quantile, smallest
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.waypoint_sets import HALL, KINDS, TRACKS, clearance, furnished_room, waypoint_set

SETS, TIGHT, WITHIN, FURNISHED, TRACK = "sets", "tight", "within", "furnished", "track"
WAYS = (SETS, TIGHT, WITHIN)
_NAMES = {SETS: "exactly, in their rooms", TIGHT: "in tight rooms", WITHIN: "within a distance"}
AROUND = 0.35  # m between the box of the waypoints and the walls of a tight room
HALL_KIND = list(KINDS)[1]
_BESIDE = 0.2  # m between the waypoints in a hall and its walls
_AROUND_TRACKS = 2.0  # m between the waypoints of a track and its walls
_ROUNDING = 1e-9  # fraction of a time
_FEW = 10  # waypoints, up to which times are compared


@dataclass(frozen=True, slots=True)
class Settings:
    """The sets of waypoints."""

    sets: int = option(400, "Number of sets of waypoints.", least=1)
    first_seed: int = option(0, "Seed of the first set.", least=0)
    rooms: int = option(200, "Number of rooms with obstacles.", least=0)
    distance: float = option(0.1, "Distance within which waypoints are passed, m.", least=0.0)


@dataclass(frozen=True, slots=True)
class ChosenFlight:
    """The flight along the chosen path through one set of waypoints."""

    how: str
    kind: str
    waypoints: int
    duration: float  # s; NaN where there is no flight
    min_snap: float  # s, along the better path of least snap; NaN where that cannot be flown
    point_mass: float  # s, of a point mass; NaN where that was not computed
    excursion: float  # m, by which the path leaves the box of the waypoints
    seconds: float  # of processor time, to choose the path and certify it
    certified: bool
    refused: str  # why it is not flown; empty if it is
    obstacles: int = 0
    clearance: float = math.nan  # m, between the flight and the obstacles
    lost: str = ""  # why link loss does not let it be flown; empty if it does

    @property
    def over(self) -> float:
        """Return the relative excess of the flight's time over that of the point mass."""
        return self.duration / self.point_mass - 1.0

    @property
    def saved(self) -> float:
        """Return the fraction of the time along min-snap that is saved."""
        return 1.0 - self.duration / self.min_snap

    @property
    def few(self) -> bool:
        """Return whether there are at most ten waypoints."""
        return self.waypoints <= _FEW


def work(settings: Settings, run: Run) -> Work:
    """Return one case per set and way of flying it, and one per track. Raises what reading safety.yaml raises."""
    limits = limits_for(Path())
    seeds = range(settings.first_seed, settings.first_seed + settings.sets)
    cases: dict[str, tuple[str, int | str]] = {f"{how} {seed}": (how, seed) for how in WAYS for seed in seeds}
    rooms = range(settings.first_seed, settings.first_seed + settings.rooms)
    cases |= {f"{FURNISHED} {seed}": (FURNISHED, seed) for seed in rooms}
    cases |= {name: (TRACK, name) for name in TRACKS}
    _fly(path_through(TRACKS["lawn mower"]), limits)  # so that no case waits for compiling
    return Work(cases, partial(measure, limits=limits, distance=settings.distance), ChosenFlight)


def measure(case: tuple[str, int | str], limits: Limits, distance: float) -> ChosenFlight:
    """Choose the path of a case, certify the flight along it, and compare."""
    how, which = case
    if how == FURNISHED:
        return _measure_furnished(int(which), limits)
    kind, points = (str(which), TRACKS[str(which)]) if how == TRACK else waypoint_set(int(which))
    path_file = path_through(points)
    if how == WITHIN:
        path_file = replace(path_file, regions=(None, *(Within(distance) for _ in points[1:-1]), None))
    within = replace(limits, space=_space(how, kind, points, limits.space))
    point_mass = point_mass_time(points, limits.plan) if how in (SETS, TRACK) else None
    begun = time.process_time()
    planned, chosen, refused = None, None, ""
    try:
        planned, chosen = _fly(path_file, within)
    except CfplanError as error:
        refused = error.what
    seconds = time.process_time() - begun
    excursion = math.nan
    if planned:
        places = planned.path(np.linspace(0.0, planned.path.end, 50 * len(planned.path.breaks)))
        excursion = float(np.maximum(points.min(axis=0) - places, places - points.max(axis=0)).max(initial=0.0))
    return ChosenFlight(
        how, kind, len(points), planned.trajectory.duration if planned else math.nan,
        chosen.min_snap if chosen and chosen.min_snap < math.inf else math.nan,
        math.nan if point_mass is None else point_mass, excursion, seconds,
        planned is not None and planned.certificate.passed, refused,
    )  # fmt: skip


def _measure_furnished(seed: int, limits: Limits) -> ChosenFlight:
    """Plan a flight among obstacles, and let it give way for link loss and stops; measure its clearance from them."""
    space, points = furnished_room(seed, limits.space)
    begun = time.process_time()
    planned, refused, least, lost = None, "", math.nan, ""
    try:
        planned, _ = _fly(path_through(points), replace(limits, space=space))
    except CfplanError as error:
        refused = error.what
    seconds = time.process_time() - begun
    if planned:
        times = np.arange(0.0, planned.trajectory.duration, 1e-3)
        least = clearance(planned.trajectory.at(times).position, space.obstacles)
        try:
            give_way(planned)
        except CfplanError as error:
            lost = error.what
    return ChosenFlight(
        FURNISHED, "", len(points), planned.trajectory.duration if planned else math.nan, math.nan, math.nan, math.nan,
        seconds, planned is not None and planned.certificate.passed, refused, len(space.obstacles), least, lost,
    )  # fmt: skip


def _fly(path_file: PathFile, limits: Limits) -> tuple[Plan, FastestPath]:
    """Return the plan along the chosen path, and the choice. Raises a CfplanError."""
    chosen = fastest_path(path_file, limits)
    return plan(chosen.path, limits.airframe, limits), chosen


def _space(how: str, kind: str, points: NDArray, shipped: Space) -> Space:
    """Return the room in which a set is flown."""
    low, high = points.min(axis=0), points.max(axis=0)
    if how == TIGHT:
        low, high = low - AROUND, high + AROUND
    elif how == TRACK:
        low, high = low - _AROUND_TRACKS, high + _AROUND_TRACKS
    elif kind == HALL_KIND:
        low, high = HALL[0] - [_BESIDE, _BESIDE, HALL[0, 2]], HALL[1] + _BESIDE
    else:
        return shipped
    return replace(shipped, low=tuple(low.tolist()), high=tuple(high.tolist()))


_PATHS = (
    Column("kind", "waypoints"),
    Column("sets", "sets", value=count()),
    Column("flown", "certified", of="sets", value=count("certified")),
)
_ALL = Column("how", "waypoints")
COLUMNS = (
    *_PATHS,
    Column("over_median", "above the point mass, median", "%", ".1f", value=quantile("over", 0.5)),
    Column("over_p95", "p95", "%", ".1f", value=quantile("over", 0.95)),
    Column("saved", "sooner than min-snap", "%", ".1f", meaning="in the mean, where min-snap can be flown",
           value=mean("saved")),
    Column("min_snap", "min-snap flown", of="sets", value=count(lambda row: math.isfinite(row.min_snap))),
    Column("slower", "later than min-snap", of="sets", value=count(lambda row: row.saved < -_ROUNDING)),
    Column("excursion", "out of the waypoints' box, p95", "m", ".2f", value=quantile("excursion", 0.95)),
    Column("farthest", "farthest", "m", ".2f", value=largest("excursion")),
)  # fmt: skip
TIME_COLUMNS = (
    Column("how", "flown"),
    Column("sets", "sets of at most ten", value=count("few")),
    Column("median", "median", "s", ".2f", value=among("few", quantile("seconds", 0.5))),
    Column("p99", "p99", "s", ".2f", value=among("few", quantile("seconds", 0.99))),
    Column("longest", "longest of all", "s", ".2f", value=largest("seconds")),
)
FURNISHED_COLUMNS = (
    Column("obstacles", "obstacles"),
    Column("rooms", "rooms", value=count()),
    Column("flown", "certified", of="rooms", value=count("certified")),
    Column("comes_down", "link loss ends clear", of="rooms",
           value=count(lambda row: row.certified and not row.lost)),
    Column("clearance", "least distance", "m", ".3f", meaning="between flights and obstacles; plans keep 0.2 m",
           value=smallest("clearance")),
    Column("median", "to choose and certify, median", "s", ".2f", value=quantile("seconds", 0.5)),
    Column("longest", "longest", "s", ".2f", value=largest("seconds")),
)  # fmt: skip
TRACK_COLUMNS = (
    Column("kind", "track"),
    Column("waypoints", "waypoints"),
    Column("duration", "flight", "s", ".2f"),
    Column("min_snap", "along min-snap", "s", ".2f"),
    Column("point_mass", "a point mass", "s", ".2f"),
    Column("seconds", "to choose and certify", "s", ".2f"),
)


def tables(settings: Settings, rows: list[ChosenFlight]) -> Iterator[Table]:
    """Yield the sets, their flights in tight rooms and within a distance, the time of choosing, and the tracks."""
    by_way = {how: [row for row in rows if row.how == how] for how in (*WAYS, FURNISHED, TRACK)}
    yield table("sets", "Chosen paths through sets of waypoints", COLUMNS, by_way[SETS], by=("kind",), last="all")
    exact = {(row.kind, place): row for place, row in enumerate(by_way[SETS])}
    gains = [
        1.0 - row.duration / exact[row.kind, place].duration for place, row in enumerate(by_way[WITHIN])
        if (row.kind, place) in exact
    ]  # fmt: skip
    gained = Column("gained", "sooner than exactly through them", "%", ".1f", value=lambda _: float(np.nanmean(gains)))
    yield table("within", f"Waypoints passed within {settings.distance:g} m", (_ALL, *_PATHS[1:], gained),
                by_way[WITHIN], by=("how",))  # fmt: skip
    yield table("tight", f"In rooms {AROUND:g} m around the waypoints", _PATHS, by_way[TIGHT], by=("kind",), last="all")
    sets = [replace(row, how=_NAMES[row.how]) for row in rows if row.how in _NAMES]
    yield table("seconds", "Time to choose a path and certify its flight", TIME_COLUMNS, sets, by=("how",))
    yield table("furnished", "In rooms with obstacles between the waypoints", FURNISHED_COLUMNS, by_way[FURNISHED],
                by=("obstacles",), last="all")  # fmt: skip
    refused = [row for row in by_way[FURNISHED] if row.refused or not row.certified]
    yield table("refused", "Rooms in which no flight was found", (Column("obstacles", "obstacles"),
                Column("refused", "refused, as")), refused)  # fmt: skip
    yield table("tracks", "Tracks with published coordinates", TRACK_COLUMNS, by_way[TRACK])


STUDY = Study(Settings, work, tables, "--sets 400 --workers 1 -o results/waypoints.json", one_at_a_time=True)
