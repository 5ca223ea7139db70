"""Figure of a plan and its flight, for print: the room from above and from the side, and the active limits.

White background, labelled axes in metres with equal scales, and each limit in its colour of the rerun view.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cfplan.files.atomic import check_new_file, write_atomically
from cfplan.geometry.path import Path as CurvePath
from cfplan.geometry.path_file import PathFile
from cfplan.geometry.waypoints import Gate, Within
from cfplan.planning.active_limits import FREE, FREE_COLOUR, LIMIT_COLOURS, ActiveLimits, active_limits, on_white
from cfplan.planning.plan_result import Plan
from cfplan.safety.space import Space, outline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".pdf", ".svg")
SHOWN = 0.5  # largest usage from which a limit gets a curve
INSET = 0.06  # m, least half side of the magnified area
FLOWN = "#141414"  # colour of the flown path
OBSTACLE = "#c9bfae"
AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """The flown motion along a plan."""

    time: NDArray  # (N,) s from the start of the path
    position: NDArray  # (N, 3) m
    deviation: NDArray  # (N,) m, from the plan at that time


def check_figure_file(file: Path, *, overwrite: bool) -> None:
    """Raise InputError if no figure can be written there."""
    check_new_file(file, *SUFFIXES, overwrite=overwrite)


def draw_plan(
    plan: Plan,
    name: str,
    flown: Flown | None = None,
    path_file: PathFile | None = None,
    least_snap: CurvePath | None = None,
) -> "Figure":
    """Return the figure of a plan, with its flight, its waypoints, and the min-snap path that it is compared with."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    active = active_limits(plan)
    low, high = np.array(plan.limits.space.low), np.array(plan.limits.space.high)
    wide = int(np.argmax((high - low)[:2]))  # the horizontal axis along the page
    size = high - low
    figure = Figure(figsize=(11.0, 6.5), layout="constrained")
    views, curves = np.asarray(figure.subfigures(1, 2, width_ratios=(1.25, 1.0))).tolist()
    above, aside = views.subplots(2, 1, height_ratios=(size[1 - wide] + 0.6, size[2] + 0.6))
    for axes, (across, up) in ((above, (wide, 1 - wide)), (aside, (wide, 2))):
        if least_snap is not None:
            s = np.linspace(0.0, least_snap.end, 1000)
            axes.plot(*least_snap(s)[:, (across, up)].T, color="0.6", lw=1.0, ls=":", label="min-snap")
        if path_file is not None and path_file.regions:
            _draw_waypoints(axes, path_file, across, up)
        _draw_view(axes, plan, active, flown, across, up)
    above.set_title("from above", loc="left", fontsize=9)
    aside.set_title("from the side", loc="left", fontsize=9)
    rows: Sequence[Axes] = curves.subplots(2 if flown is None else 3, 1, sharex=True).tolist()
    draw_speed(rows[0], plan, active)
    _draw_shares(rows[1], active)
    if flown is not None:
        rows[2].plot(flown.time, 100.0 * flown.deviation, color=FLOWN, lw=1.0)
        rows[2].set(ylabel="deviation, cm", ylim=(0.0, None))
    rows[-1].set_xlabel("time from the start of the path, s")
    for axes in (above, aside, *rows):
        axes.grid(alpha=0.25)
    figure.suptitle(caption(plan, name), fontsize=11, parse_math=False)
    handles, labels = above.get_legend_handles_labels()
    names = _shown(active) + ([FREE] if FREE in active.name else [])
    handles += [Line2D([], [], color=limit_colour(name), lw=2.6) for name in names]
    labels += ["no limit" if name == FREE else name for name in names]
    views.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def caption(plan: Plan, name: str) -> str:
    """Return the line above a plan: its name, length, travel time and vehicle."""
    return f"{name}: {plan.path.length:.1f} m in {plan.trajectory.duration:.2f} s, {plan.airframe.name}"


def save_figure(figure: "Figure", file: Path, *, overwrite: bool = False) -> None:
    """Write a figure atomically. Raises InputError if it cannot be written."""
    from io import BytesIO

    check_figure_file(file, overwrite=overwrite)
    content = BytesIO()
    figure.savefig(content, format=file.suffix[1:], dpi=150)
    write_atomically(file, content.getvalue())


def _draw_view(axes: "Axes", plan: Plan, active: ActiveLimits, flown: Flown | None, across: int, up: int) -> None:
    """Draw the room and its content along two of its axes."""
    from matplotlib.patches import Rectangle

    space = plan.limits.space
    low, high = np.array(space.low)[[across, up]], np.array(space.high)[[across, up]]
    for inset, style in ((0.0, {"lw": 1.4}), (space.margin, {"lw": 0.8, "ls": "--"})):
        corner, size = low + inset, high - low - 2 * inset
        axes.add_patch(Rectangle((corner[0], corner[1]), size[0], size[1], fill=False, ec="0.35", **style))
    _draw_obstacles(axes, space, across, up)
    axes.set(xlim=(low[0] - 0.3, high[0] + 0.3), ylim=(low[1] - 0.3, high[1] + 0.3), aspect="equal")
    if across == 1:  # with x up the page, y grows to the left
        axes.invert_xaxis()
    axes.set(xlabel=f"{AXES[across]}, m", ylabel=f"{AXES[up]}, m")
    draw_path(axes, active, across, up)
    begin, end = active.position[0], active.position[-1]
    axes.plot(begin[across], begin[up], "o", color="black", mfc="white", ms=6, label="start")
    axes.plot(end[across], end[up], "s", color="black", ms=5, label="end")
    if flown is None:
        return
    axes.plot(flown.position[:, across], flown.position[:, up], color=FLOWN, lw=0.8, label="flown")
    if up != 2:  # the largest deviation, magnified, from above
        _magnify(axes, active, flown, across, up)


def _draw_waypoints(axes: "Axes", path_file: PathFile, across: int, up: int) -> None:
    """Draw waypoints, with the distances within which they are passed and the openings of gates, along two axes."""
    from matplotlib.patches import Circle

    axes.plot(*path_file.waypoints[:, (across, up)].T, "+", color="0.2", ms=7, label="waypoints")
    for point, region in zip(path_file.waypoints, path_file.regions, strict=True):
        if isinstance(region, Within):
            axes.add_patch(Circle((point[across], point[up]), region.radius, fill=False, ec="0.2", lw=0.7))
        elif isinstance(region, Gate):
            sides, top = region.half_axes(0.0)
            corners = point + np.array([sides + top, sides - top, -sides - top, top - sides, sides + top])
            axes.plot(*corners[:, (across, up)].T, color="0.2", lw=1.4)


def _draw_obstacles(axes: "Axes", space: Space, across: int, up: int) -> None:
    """Draw the obstacles along two of the room's axes, with their names."""
    for obstacle in space.obstacles:
        _, _, z, _, _, tall, _, _ = obstacle.prism
        around = outline(obstacle)
        corners = np.column_stack([np.repeat(around, 2, axis=0), np.tile([z - tall, z + tall], len(around))])
        low, high = corners.min(axis=0)[[across, up]], corners.max(axis=0)[[across, up]]
        shape = around[:, [across, up]] if up != 2 else [low, (high[0], low[1]), high, (low[0], high[1])]
        axes.fill(*np.transpose(shape), color=OBSTACLE, lw=0.0)
        if obstacle.name and up != 2:
            x, y = ((low + high) / 2).tolist()
            axes.text(x, y, obstacle.name, ha="center", va="center", fontsize=7, parse_math=False, clip_on=True)


def draw_path(axes: "Axes", active: ActiveLimits, *along: int) -> None:
    """Draw the path in the colours of its active limits, along two or all of the room's axes."""
    for name, rows in active.stretches():
        axes.plot(*active.position[rows][:, along].T, color=limit_colour(name), lw=2.6)


def _magnify(axes: "Axes", active: ActiveLimits, flown: Flown, across: int, up: int) -> None:
    """Magnify the largest deviation, in the corner with the least of the path."""
    worst = int(np.argmax(flown.deviation))
    centre = flown.position[worst, [across, up]]
    half = max(INSET, 2.5 * float(flown.deviation[worst]))
    shown = axes.transAxes.inverted().transform(axes.transData.transform(active.position[:, [across, up]]))
    size = np.array([0.27, 0.31])
    corners = [np.array([x, y]) for y in (0.67, 0.02) for x in (0.02, 0.71)]
    free = min(corners, key=lambda corner: int(np.all((shown > corner) & (shown < corner + size), axis=1).sum()))
    inset = axes.inset_axes((*free, *size), xticks=[], yticks=[])
    draw_path(inset, active, across, up)
    inset.plot(flown.position[:, across], flown.position[:, up], color=FLOWN, lw=0.8)
    wanted = [float(np.interp(flown.time[worst], active.time, active.position[:, axis])) for axis in (across, up)]
    inset.plot(*zip(wanted, centre.tolist(), strict=True), color=FLOWN, lw=1.2)
    inset.plot(*wanted, "o", color="black", mfc="white", ms=4)
    inset.plot(*centre.tolist(), "o", color="black", ms=4)
    inset.set(xlim=centre[0] + np.array([-half, half]), ylim=centre[1] + np.array([-half, half]), aspect="equal")
    if axes.xaxis_inverted():
        inset.invert_xaxis()
    for height, label in ((0.87, f"{100 * flown.deviation[worst]:.1f} cm off"), (0.04, "○ planned  ● flown")):
        inset.text(0.5, height, label, transform=inset.transAxes, ha="center", fontsize=6)
    axes.indicate_inset_zoom(inset, edgecolor="0.3")


def draw_speed(axes: "Axes", plan: Plan, active: ActiveLimits) -> None:
    """Draw the plan's speed over time, and its limit."""
    speed = np.linalg.norm(plan.trajectory.at(active.time).velocity, axis=1)
    axes.plot(active.time, speed, color=limit_colour("speed"), lw=1.4)
    axes.axhline(plan.limits.plan.speed, color="0.35", lw=0.8, ls="--")
    axes.set(ylabel="speed, m/s", ylim=(0.0, None))


def _draw_shares(axes: "Axes", active: ActiveLimits) -> None:
    for name in _shown(active):
        axes.plot(active.time, 100.0 * active.shares[name], color=limit_colour(name), lw=1.0)
    axes.axhline(100.0, color="0.35", lw=0.8, ls="--")
    axes.set(ylabel="share of the limit, %", ylim=(0.0, 108.0))


def _shown(active: ActiveLimits) -> list[str]:
    return [name for name, share in active.shares.items() if share.max() >= SHOWN]


def limit_colour(name: str) -> str:
    """Return the colour of a limit on white paper."""
    return on_white(FREE_COLOUR if name == FREE else LIMIT_COLOURS[name])
