"""A planned fleet as a figure for print: all paths from above, the distances over time, and the conflict maps.

The conflict map of a pair has the time on one plan against that on the other. Where both vehicles would be nearer than
`apart`, it is filled; the line is how the clocks of the two run, from the fleet's start to its end.
"""

import itertools
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cfplan.planning.figure import AXES, OBSTACLE
from cfplan.planning.fleet.members import FleetMember, places
from cfplan.preparation.plan_fleet import PlannedFleet
from cfplan.safety.space import Space, outline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEP = 0.02  # s between the moments that are drawn
SHOWN = 4.0  # times `apart`, to which distances are drawn
_CONFLICT, _LIMIT = "#e8b4b4", "#b02020"


def draw_fleet(fleet: PlannedFleet) -> "Figure":
    """Return the figure of a planned fleet; a pair whose paths nowhere come too near has no conflict map."""
    from matplotlib.figure import Figure

    space, end = fleet.limits.space, fleet.end
    pairs = [(a, b, _near(a, b, fleet.apart)) for a, b in itertools.combinations(fleet.members, 2)]
    conflicts = [(a, b, near) for a, b, near in pairs if near.any()]
    figure = Figure(figsize=(11.0 if conflicts else 6.5, 6.5), layout="constrained")
    left, right = (
        np.asarray(figure.subfigures(1, 2, width_ratios=(1.25, 1.0))).tolist() if conflicts else (figure, None)
    )
    if right is not None:
        columns = int(np.ceil(np.sqrt(len(conflicts))))
        maps = right.subplots(-(-len(conflicts) // columns), columns, squeeze=False).ravel()
        for axes, (a, b, near) in zip(maps, conflicts, strict=False):
            _draw_map(axes, a, b, near, end)
        for axes in maps[len(conflicts) :]:
            axes.remove()
        right.suptitle(f"conflict maps: nearer than {fleet.apart:g} m where filled; time on each plan, s", fontsize=9)
    above, over = left.subplots(2, 1, height_ratios=(1.6, 1.0))
    _draw_room(above, space)
    _draw_paths(above, fleet, wide=_wide(space))
    _draw_distances(over, fleet)
    figure.suptitle(f"{fleet.name}: {len(fleet.members)} vehicles in {end:.2f} s", fontsize=11, parse_math=False)
    return figure


def _near(a: FleetMember, b: FleetMember, apart: float) -> NDArray:
    """Return whether two are too near at each time on the plan of one and of the other, (U, V) bool."""
    of_a, of_b = (places(each.plan.trajectory, _own_times(each)) for each in (a, b))
    return np.asarray(np.linalg.norm(of_a[:, None] - of_b, axis=2) < apart)


def _own_times(member: FleetMember) -> NDArray:
    return np.arange(0.0, member.plan.trajectory.duration + STEP, STEP)


def _wide(space: Space) -> int:
    """Return the horizontal axis along the page, the longer one."""
    return int(np.argmax((np.array(space.high) - np.array(space.low))[:2]))


def _draw_room(axes: "Axes", space: Space) -> None:
    from matplotlib.patches import Rectangle

    wide = _wide(space)
    along = [wide, 1 - wide]
    low, high = np.array(space.low)[along], np.array(space.high)[along]
    for inset, style in ((0.0, {"lw": 1.4}), (space.margin, {"lw": 0.8, "ls": "--"})):
        axes.add_patch(
            Rectangle((low[0] + inset, low[1] + inset), *(high - low - 2 * inset), fill=False, ec="0.35", **style)
        )
    for obstacle in space.obstacles:
        axes.fill(*outline(obstacle)[:, along].T, color=OBSTACLE, lw=0.0)
    axes.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3), aspect="equal")
    if wide == 1:  # with x up the page, y grows to the left
        axes.invert_xaxis()
    axes.set(xlabel=f"{AXES[wide]}, m", ylabel=f"{AXES[1 - wide]}, m")
    axes.grid(alpha=0.25)


def _draw_paths(axes: "Axes", fleet: PlannedFleet, wide: int) -> None:
    for number, member in enumerate(fleet.members):
        track = places(member.plan.trajectory, _own_times(member))[:, [wide, 1 - wide]]
        axes.plot(*track.T, color=f"C{number}", lw=1.8, label=_label(member.name))
        axes.plot(*track[0], "o", color=f"C{number}", mfc="white", ms=6)
        axes.plot(*track[-1], "s", color=f"C{number}", ms=5)
    nearest = fleet.separations[0]
    axes.plot(nearest.place[wide], nearest.place[1 - wide], "x", color=_LIMIT, ms=9, mew=2.0, label="nearest")
    axes.set_title("from above: ○ start, ■ end, × where two are nearest", loc="left", fontsize=9)
    axes.legend(fontsize=8, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def _draw_distances(axes: "Axes", fleet: PlannedFleet) -> None:
    """Draw the distance of each pair over time, the least over the skew, and where the certificate finds it least."""
    times = np.arange(0.0, fleet.end + STEP, STEP)
    skews = np.linspace(-fleet.skew, fleet.skew, 7)
    numbers = {member.name: number for number, member in enumerate(fleet.members)}
    for separation in fleet.separations:
        a, b = (numbers[name] for name in separation.pair)
        of_a, of_b = fleet.members[a].columns(times), [fleet.members[b].columns(times + skew) for skew in skews]
        distance = np.min([np.linalg.norm(of_a - each, axis=1) for each in of_b], axis=0)
        axes.plot(times, distance, color=f"C{a}", lw=1.6)
        axes.plot(times, distance, color=f"C{b}", lw=1.6, ls=(0, (4, 4)))
        axes.plot(separation.time, separation.distance, ".", color="black")
    axes.axhline(fleet.apart, color=_LIMIT, lw=1.0, ls="--")
    axes.set(ylim=(0.0, SHOWN * fleet.apart), xlim=(0.0, fleet.end), ylabel="distance, m")
    axes.set_xlabel("time from the fleet's start, s")
    axes.set_title(f"distance of each pair, in the colours of both; at least {fleet.apart:g} m", loc="left", fontsize=9)
    axes.grid(alpha=0.25)


def _draw_map(axes: "Axes", a: FleetMember, b: FleetMember, near: NDArray, end: float) -> None:
    axes.contourf(_own_times(a), _own_times(b), near.T.astype(float), levels=[0.5, 1.5], colors=[_CONFLICT])
    times = np.arange(0.0, end + STEP, STEP)
    own = [np.clip(times - each.delay, 0.0, each.plan.trajectory.duration) for each in (a, b)]
    axes.plot(*own, color="black", lw=1.2)
    axes.set(xlim=(0.0, _own_times(a)[-1]), ylim=(0.0, _own_times(b)[-1]), aspect="equal")
    axes.set_xlabel(a.name, fontsize=8, parse_math=False)
    axes.set_ylabel(b.name, fontsize=8, parse_math=False)
    axes.tick_params(labelsize=7)


def _label(name: str) -> str:
    """Return a name for a legend, which leaves out those that begin with an underscore, and reads $ as a formula."""
    return name.replace("$", r"\$").lstrip("_") or "vehicle"
