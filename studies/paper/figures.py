"""The paper's figures, drawn from results/: paths of the baselines with AllocNet's boxes, yaw consistency, tracks."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.planning.figure import save_figure
from cfplan.simulation.geometric_flight import LOST
from studies.paper.baselines import ALLOCATION, BAYESIAN, DRAWN, SHIPPED
from studies.paper.hardware import CERTIFIED, LONG, RAW, TRACKED
from studies.paper.trials import TOPPQUAD
from studies.paper.yaw_consistency import WAYS
from studies.runner.result import StudyResult, read_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = MappingProxyType({SHIPPED: "#7b3fa0", BAYESIAN: "#c04a2b", ALLOCATION: "#1f7a4d"})
DIFFERENCES = (("h", "largest Δh"), ("time", "Δtime, s"), ("yaw", "largest Δyaw, rad"))  # of the paper's histograms
BINS = 20
NETWORKS = MappingProxyType({"LSTM-0.001": "#7b3fa0", "LSTM-0.01": "#1f7a4d", "LSTM-0.1": "#c0282b"})  # as in the paper
LONG_STYLES = MappingProxyType({
    "": {"color": "black", "ls": "--", "zorder": 3}, TOPPQUAD: {"color": "#2b5fc0", "ls": "--", "zorder": 2},
})  # fmt: skip
PANELS = 4  # of tracks, in a line
EDGES = tuple((corner, corner | 1 << axis) for corner in range(8) for axis in range(3) if not corner & 1 << axis)
Row = Mapping[str, Any]


class Drawing(NamedTuple):
    """One figure: the study whose result it is drawn from, and how."""

    study: str
    draw: Callable[[StudyResult], "Figure"]


class Written(NamedTuple):
    """What became of a figure."""

    file: Path
    left_out: str  # why there is none; empty where it was drawn


def write_figures(results: Path, images: Path) -> list[Written]:
    """Draw each of FIGURES from the results in one folder, into the other; those without a result are left out.

    Raises:
        InputError: no such folder, or a figure that cannot be written.
    """
    if not images.is_dir():
        raise InputError("no such folder", where=str(images), hint="make it first")
    written = []
    for name, drawing in FIGURES.items():
        file = images / f"{name}.png"
        try:
            figure = drawing.draw(read_result(results / f"{drawing.study}.json"))
        except InputError as error:
            written.append(Written(file, str(error)))
            continue
        save_figure(figure, file, overwrite=True)
        written.append(Written(file, ""))
    return written


def draw_baselines(result: StudyResult) -> "Figure":
    """Draw the paths of a row of planners through the same waypoints, and the boxes that AllocNet's kind is given."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    rows = result.table("drawn").rows
    seeds = list(dict.fromkeys(row["seed"] for row in rows))
    if not seeds:
        raise InputError("no path was flown by any planner", where="drawn", hint="run cfplan study baselines anew")
    figure = Figure(figsize=(3.2 * len(DRAWN), 2.6 * len(seeds)), layout=ConstrainedLayoutEngine(rect=(0, 0, 0.97, 1)))
    for line, seed in enumerate(seeds):
        own = [row for row in rows if row["seed"] == seed]
        for column, name in enumerate(DRAWN):
            axes = figure.add_subplot(len(seeds), len(DRAWN), line * len(DRAWN) + column + 1, projection="3d")
            _draw_motion(axes, own, name)
            if line == 0:
                axes.set_title(name, fontsize=10)
    return figure


def _draw_motion(axes: Any, rows: Sequence[Row], name: str) -> None:
    from matplotlib.ticker import MaxNLocator

    (waypoints,) = _points(rows, "waypoints")
    boxes = _points(rows, "box") if name == ALLOCATION else []
    if name == ALLOCATION:
        waypoints = waypoints[[0, -1]]  # it keeps no other
    for box in boxes:
        for edge in EDGES:
            axes.plot(*box[list(edge)].T, color="0.55", lw=0.7)
    for points in _points(rows, name):
        axes.plot(*points.T, color=COLOURS[name], lw=1.6)
    axes.plot(*waypoints.T, "o", color="black", ms=3.5)
    for axis, label in ((axes.xaxis, "x, m"), (axes.yaxis, "y, m"), (axes.zaxis, "z, m")):
        axis.set_label_text(label, fontsize=7)
        axis.labelpad = -6.0
        axis.set_major_locator(MaxNLocator(4, integer=True))
    axes.tick_params(labelsize=6, pad=-3.0)
    everything = np.concatenate([row["points"] for row in rows])
    axes.set(
        **dict(zip(("xlim", "ylim", "zlim"), np.stack([everything.min(0), everything.max(0)], axis=1), strict=True))
    )
    axes.set_aspect("equal")


def draw_yaw_consistency(result: StudyResult) -> "Figure":
    """Draw the histograms of the largest differences within pairs of paths, a row for each way to plan them."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    rows = [row for row in result.table("pairs").rows if not row["reason"]]
    figure = Figure(figsize=(10.0, 2.3 * len(WAYS)), layout="constrained")
    grid = np.asarray(figure.subplots(len(WAYS), len(DIFFERENCES), sharex="col", sharey="col"))
    for column, (key, label) in enumerate(DIFFERENCES):
        bins = np.linspace(0.0, max((row[key] for row in rows), default=1.0), BINS + 1)
        for line, way in enumerate(WAYS):
            axes = grid[line, column]
            axes.hist([row[key] for row in rows if row["planner"] == way], bins, color="#4a6fa5")
            axes.grid(alpha=0.25)
            axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
            axes.set(xlabel=label if line == len(WAYS) - 1 else "", ylabel=f"{way}\npairs" if column == 0 else "")
    return figure


def draw_tracks(result: StudyResult, network: str) -> "Figure":
    """Draw the flights of a network and of TOPPQuad over their paths, from above: as planned, then certified."""
    from matplotlib.figure import Figure

    rows = [row for row in result.table("tracks").rows if row["path"] != LONG]
    paths = {row["path"]: np.array(row["points"]) / 1000.0 for row in rows if not row["planner"]}
    lines = -(-len(paths) // PANELS)
    figure = Figure(figsize=(2.4 * PANELS, 2 * 2.5 * lines), layout="constrained")
    parts = np.atleast_1d(np.asarray(figure.subfigures(2, 1))).tolist()
    for part, way in zip(parts, (RAW, CERTIFIED), strict=True):
        part.suptitle(f"{network}, {way}", fontsize=10)
        grid = np.atleast_1d(part.subplots(lines, PANELS)).ravel()
        for axes, (name, path) in zip(grid, paths.items(), strict=False):
            axes.plot(path[:, 0], path[:, 1], "--", color="black", lw=0.9, zorder=3)
            for row in rows:
                if (row["path"], row["way"]) == (name, way) and row["planner"] in (TOPPQUAD, network):
                    own = row["planner"] == network
                    style = {"color": NETWORKS[network]} if own else {"color": "#2b5fc0", "ls": "--", "zorder": 2}
                    track = np.array(row["points"]) / 1000.0
                    axes.plot(track[:, 0], track[:, 1], lw=0.9, **style)
            axes.set_title(f"path {name}{_failures(result, name, way, network)}", fontsize=8)
            axes.set_aspect("equal")
            axes.tick_params(labelsize=6)
        for axes in grid[len(paths) :]:
            axes.set_visible(False)
    return figure


def _failures(result: StudyResult, path: str, way: str, network: str) -> str:
    flown = [
        row for row in result.table("flights").rows
        if (row["limits"], row["path"], row["way"], row["planner"]) == (TRACKED, path, way, network)
    ]  # fmt: skip
    failed = sum(bool(row["reason"]) or row["deviation"] is None or row["deviation"] >= LOST for row in flown)
    return f": {failed} of {len(flown)} failed" if failed else ""


def draw_long(result: StudyResult) -> "Figure":
    """Draw the flights over the long path, certified, from above and from the side: the planner's that ships."""
    from matplotlib.figure import Figure

    rows = [row for row in result.table("tracks").rows if row["path"] == LONG and row["way"] in ("", CERTIFIED)]
    if not any(row["planner"] == SHIPPED for row in rows):
        raise InputError(
            "no flight of the planner that ships over the long path",
            where="tracks",
            hint="run cfplan study hardware anew",
        )
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    for axes, (first, second) in zip(figure.subplots(1, 2), ((0, 1), (1, 2)), strict=True):
        for row in rows:
            points = np.array(row["points"]) / 1000.0
            style = LONG_STYLES.get(row["planner"], {"color": COLOURS[SHIPPED]})
            axes.plot(points[:, first], points[:, second], lw=0.9, **style)
        axes.set(xlabel=f"{'xyz'[first]}, m", ylabel=f"{'xyz'[second]}, m")
        axes.set_aspect("equal")
    return figure


def _points(rows: Sequence[Row], what: str) -> list[NDArray]:
    return [np.array(row["points"]) for row in rows if row["what"] == what]


FIGURES: MappingProxyType[str, Drawing] = MappingProxyType({
    "paper-baselines": Drawing("baselines", draw_baselines),
    "paper-yaw": Drawing("yaw-consistency", draw_yaw_consistency),
    **{f"paper-{name}": Drawing("hardware", partial(draw_tracks, network=name)) for name in NETWORKS},
    "paper-long": Drawing("hardware", draw_long),
})  # fmt: skip
