"""Lead the path of a vehicle around another one where no start delays and clock rates keep the two apart.

A column of the blocking vehicle becomes an obstacle when the path of the blocked one is chosen again: where it starts,
where it ends, or where it blocks, whichever that path does not keep clear of and can be led around. If there is none,
the path of the other one is led around the blocked one. Paths that cfplan does not choose stay as they are.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from cfplan.errors import InfeasibleError
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import PathShape
from cfplan.planning.fleet.coordination import Blocked, Finish
from cfplan.planning.fleet.fleet_file import FleetFile
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.path.choice import chosen_path
from cfplan.preparation.plan_flight import FlightOptions, plan_flight
from cfplan.safety.limits import Limits
from cfplan.safety.space import Cylinder, Space, distances_beyond, inside

_MOST = 4  # paths of a fleet that are chosen again
_ASIDE = 0.05  # m added to the distance to keep, so that the clocks have room


@dataclass(slots=True)
class PathsAround:
    """The columns that the paths of a fleet lead around."""

    fleet: FleetFile
    limits: Limits
    options: FlightOptions | None = None
    finish: Finish | None = None  # of plans along other paths
    columns: dict[int, list[Cylinder]] = field(default_factory=dict)  # of each vehicle whose path was chosen again

    def lead(self, members: Sequence[FleetMember], blocked: Blocked) -> list[FleetMember] | None:
        """Return the members with one path led around the other vehicle of a blocked pair; None if neither can be."""
        if sum(map(len, self.columns.values())) == _MOST:
            return None
        names = [member.name for member in members]
        for name, other, blocks_at in zip(blocked.pair, blocked.pair[::-1], blocked.places[::-1], strict=True):
            number, path = names.index(name), members[names.index(other)].plan.path
            for x, y in (*path(np.array([0.0, path.end]))[:, :2].tolist(), blocks_at):
                columns = [*self.columns.get(number, []), self._column(other, x, y)]
                with suppress(InfeasibleError):
                    if (member := self._led(number, members[number], columns)) is not None:
                        self.columns[number] = columns
                        return [*members[:number], member, *members[number + 1 :]]
        return None

    def describe(self) -> list[str]:
        """Return which paths lead around which vehicles, a few words each."""
        return [
            f"{self.fleet.vehicles[number].name} leads around {column.name} at ({column.x:.2f}, {column.y:.2f}) m"
            for number, columns in self.columns.items()
            for column in columns
        ]

    def _column(self, name: str, x: float, y: float) -> Cylinder:
        space = self.limits.space
        radius = max(self.fleet.apart + _ASIDE - space.margin, _ASIDE)  # the path keeps the margin from it
        return Cylinder(x, y, radius, space.low[2], space.high[2], name)

    def _led(self, number: int, member: FleetMember, columns: list[Cylinder]) -> FleetMember | None:
        """Return a vehicle on a path around columns; None if its path is not chosen, or does not get nearer to them."""
        limits, path_file = self.limits, self.fleet.vehicles[number].path_file
        space = replace(limits.space, obstacles=(*limits.space.obstacles, *columns))
        if path_file.shape is not PathShape.FASTEST or _keeps_clear(member.plan.path, space):
            return None
        around, _ = chosen_path(path_file, replace(limits, space=space))
        if not _keeps_clear(around.path, space):
            return None
        plan = plan_flight(replace(around, shape=None), limits, self.options).plan
        return replace(member, plan=plan if self.finish is None else self.finish(plan))


def _keeps_clear(path: Path, space: Space) -> bool:
    return bool(inside(distances_beyond(path, space)[1]).all())
