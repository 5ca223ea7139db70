"""The choice of the fastest path through waypoints.

A path of least snap is shaped by the times of its segments and by points between the waypoints: with times in
proportion to straight lengths it swings far out where these differ. Both are chosen for the least flight time, by
descending along its gradient (cost.py, search.py). The result and two minimum-snap paths are planned and certified, and
the shortest of these flights is used.
"""

import math
import pathlib
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InfeasibleError, InputError
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import PathFile, PathShape
from cfplan.geometry.waypoints import Gate
from cfplan.planning.path.search import ChosenKnots, search, timed
from cfplan.planning.plan import default_budget, plan
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside

CHOOSING = 0.5  # of the budget of planning
CERTIFYING = 0.2  # of the time for choosing, kept for certifying the result


class FastestPath(NamedTuple):
    """A chosen path through waypoints, its flight time, and that along min-snap."""

    path: Path
    duration: float  # s, of the certified flight at full speed; infinite if there is none
    min_snap: float  # s, likewise along the better path of least snap, with times like the lengths or centripetal ones
    least_snap: Path  # that path; if neither can be flown, the one with centripetal times
    finished: bool  # whether the search ended before the deadline

    def describe(self, speed_factor: float) -> str:
        """Return the time along min-snap at a factor of the full speed, and whether the choice was cut short."""
        flown = self.min_snap < math.inf
        beside = f"{self.min_snap / speed_factor:.2f} s along min-snap" if flown else "min-snap cannot be flown"
        return beside if self.finished else f"{beside}, choosing was cut short by the budget"


def chosen_path(
    path_file: PathFile, limits: Limits, *, budget: float | None = None, models: tuple[pathlib.Path, ...] = ()
) -> tuple[PathFile, FastestPath | None]:
    """Return the path file with the path of its shape, and the choice, if one was made.

    Choosing takes at most half of the budget of planning, s; None is that of the path of least snap.

    Raises:
        InfeasibleError: a gate or a corridor cannot be flown through.
    """
    if path_file.shape is not PathShape.FASTEST or not limits.space.holds(path_file.waypoints):
        return path_file, None  # planning refuses a waypoint outside the space
    seconds = CHOOSING * (default_budget(path_file.path) if budget is None else budget)
    fastest = fastest_path(path_file, limits, deadline=Deadline.after(seconds), models=models)
    return replace(path_file, path=fastest.path), fastest


def fastest_path(
    path_file: PathFile, limits: Limits, *, deadline: Deadline = NEVER, models: tuple[pathlib.Path, ...] = ()
) -> FastestPath:
    """Return the path through a path file's waypoints, at rest at both ends, with the shortest certified flight.

    Waypoints of several laps have the same times in each lap. After the deadline the best path found so far is
    returned. If none can be flown, it is the path that leaves the room least; planning it reports why.

    Raises:
        InfeasibleError: a gate or a corridor cannot be flown through.
    """
    _check_gates(path_file, limits)

    def certified(path: Path) -> float:
        with suppress(InfeasibleError, InputError):
            made = plan(
                path, limits.airframe, limits, yaw=path_file.yaw, yaw_angle=path_file.yaw_angle, deadline=deadline,
                models=models,
            )  # fmt: skip
            return made.trajectory.duration
        return math.inf

    points = path_file.waypoints
    paths = [knots.path for knots in timed(points, np.arange(len(points)))]
    searching = deadline.earlier(CERTIFYING * deadline.left) if deadline.left < math.inf else NEVER
    found = search(path_file, limits, searching)
    _check_kept(found, path_file)
    durations = [certified(path) for path in (found.knots.path, *paths)]
    plain = path_file.corridor is None and not limits.space.obstacles
    plain = plain and not any(isinstance(each, Gate) for each in path_file.regions)
    best = int(np.argmin(durations)) if plain else 0  # the first of equals
    least_snap = paths[0] if durations[1] < durations[2] else paths[1]
    return FastestPath(
        (found.knots.path, *paths)[best], durations[best], min(durations[1:]), least_snap, found.finished
    )


def _check_gates(path_file: PathFile, limits: Limits) -> None:
    """Raise InfeasibleError if a gate leaves no room for the vehicle."""
    margin = limits.space.margin
    for number, region in enumerate(path_file.regions, start=1):
        if isinstance(region, Gate) and min(region.width, region.height) <= 2.0 * margin:
            side = "wide" if region.width <= region.height else "high"
            raise InfeasibleError(
                f"the gate at waypoint {number} is {min(region.width, region.height):g} m {side}: the margin of "
                f"{margin:g} m at both sides leaves nothing of it",
                where=str(path_file.source),
                hint="give a larger gate, or a smaller `margin` of `space` in safety.yaml",
            )


def _check_kept(found: ChosenKnots, path_file: PathFile) -> None:
    """Raise InfeasibleError if a path leaves the corridor, or passes a gate backwards.

    Walls and obstacles are checked in planning.
    """
    path, cut, more = found.knots.path, not found.finished, "give planning more time (--budget)"
    for number, (point, region) in enumerate(zip(found.knots.waypoint, path_file.regions, strict=True), start=1):
        between = 0 < point < len(found.knots.times)
        if between and isinstance(region, Gate) and float(path(path.breaks[point], 1) @ region.forwards) <= 0.0:
            raise InfeasibleError(
                f"no path was found that passes the gate at waypoint {number} forwards",
                where=str(path_file.source),
                hint=more if cut else "add a waypoint before it or behind it, or turn its yaw_deg by 180",
            )
    if path_file.corridor is not None and not inside(found.aside):
        leg = found.aside_leg + 1
        raise InfeasibleError(
            f"no path was found that stays within {path_file.corridor:g} m of the straight lines: the best is "
            f"{found.aside + path_file.corridor:.3f} m off between waypoints {leg} and {leg + 1}",
            where=str(path_file.source),
            hint=more if cut else "widen the corridor, or give waypoints that turn less sharply",
        )
