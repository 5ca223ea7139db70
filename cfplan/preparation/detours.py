"""Replan the path of a vehicle around another one where no start delays and clock rates keep the two apart.

A column becomes an obstacle when the path of the blocked vehicle is chosen again. It stands at the other vehicle's
start, at its end, or where it blocks: the first of these that the path does not clear and that a detour can. If there
is none, the path of the other vehicle is replanned. Given curves and min-snap paths stay as they are.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError
from cfplan.geometry.path import Path
from cfplan.planning.fleet.coordination import Blocked, Finish
from cfplan.planning.fleet.fleet_file import FleetFile
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.path.choice import chosen_path
from cfplan.preparation.plan_flight import FlightOptions, plan_flight
from cfplan.safety.limits import Limits
from cfplan.safety.space import Cylinder, Space, distances_beyond, inside

_MAX_COLUMNS = 4  # of a fleet
_SLACK = 0.05  # m added to the distance to keep, at most, so that start delays and clock rates are found


@dataclass(slots=True)
class Detours:
    """Replans paths of a fleet around columns, and keeps these."""

    fleet: FleetFile
    limits: Limits
    options: FlightOptions
    finish: Finish | None = None  # applied to each replanned plan
    columns: dict[int, tuple[Cylinder, ...]] = field(default_factory=dict)  # by the number of the replanned vehicle

    def replan(self, members: Sequence[FleetMember], blocked: Blocked) -> list[FleetMember] | None:
        """Return the members with one path of a blocked pair replanned; None if neither has a detour."""
        if sum(map(len, self.columns.values())) >= _MAX_COLUMNS:
            return None
        names = [member.name for member in members]
        for name, other, blocking_place in zip(blocked.pair, blocked.pair[::-1], blocked.places[::-1], strict=True):
            number = names.index(name)
            own, others = _ends(members[number]), _ends(members[names.index(other)])
            for place in (*others, np.array(blocking_place)):
                columns = (*self.columns.get(number, ()), self._column(other, place, own))
                with suppress(CfplanError):
                    if (member := self._replanned(number, members[number], columns)) is not None:
                        self.columns[number] = columns
                        return [*members[:number], member, *members[number + 1 :]]
        return None

    def describe(self) -> list[str]:
        """Return one phrase per column."""
        return [
            f"the path of {self.fleet.vehicles[number].name} leads around {column.name} at "
            f"({column.x:.2f}, {column.y:.2f}) m"
            for number, columns in self.columns.items()
            for column in columns
        ]

    def _column(self, name: str, place: NDArray, own: NDArray) -> Cylinder:
        """Return the column that a path must avoid at a place, (2,) m.

        The path keeps `apart` plus slack from it; less slack, down to none, where an end of the replanned path, `own`,
        (2, 2) m, is nearer.
        """
        space, apart = self.limits.space, self.fleet.apart
        room = float(np.linalg.norm(own - place, axis=1).min())
        keeps = min(apart + _SLACK, max(room, apart))
        x, y = place.tolist()
        radius = max(keeps - space.margin, _SLACK)  # the path keeps the margin from it
        return Cylinder(x, y, radius, space.low[2], space.high[2], name)

    def _replanned(self, number: int, member: FleetMember, columns: tuple[Cylinder, ...]) -> FleetMember | None:
        """Return a vehicle on a path around columns; None if its path clears them already, or has no detour."""
        limits, options = self.limits, self.options
        space = replace(limits.space, obstacles=(*limits.space.obstacles, *columns))
        if _clears(member.plan.path, space):
            return None
        path_file = self.fleet.vehicles[number].path_file
        detour, _ = chosen_path(path_file, replace(limits, space=space), budget=options.budget, models=options.models)
        if not _clears(detour.path, space):
            return None
        plan = plan_flight(replace(detour, shape=None), limits, options).plan
        return replace(member, plan=plan if self.finish is None else self.finish(plan))


def _ends(member: FleetMember) -> NDArray:
    """Return x and y of a vehicle's start and end, (2, 2) m."""
    path = member.plan.path
    return np.asarray(path(np.array([0.0, path.end]))[:, :2])


def _clears(path: Path, space: Space) -> bool:
    return bool(inside(distances_beyond(path, space)[1]).all())
