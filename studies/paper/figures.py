"""Draw the paper's figures from the rows of results: baselines' paths with AllocNet's boxes, yaw, flown tracks.

The networks' training is drawn from the logs of their folders.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path import Path as PathOfMotion
from cfplan.learning.checkpoints import LOG
from cfplan.planning.figure import save_figure
from cfplan.safety.limits_file import DEFAULTS, load_limits
from studies.paper.baselines import ALLOCATION, BAYESIAN, DRAWN, SHIPPED, BaselineTrial, random_course
from studies.paper.corridors import box_corners, corridor_about
from studies.paper.hardware import CERTIFIED, LONG, RAW, TRACKED, HardwareFlight, hardware_paths, long_path
from studies.paper.training import WEIGHTS
from studies.paper.trials import TOPPQUAD, failed
from studies.paper.yaw_consistency import WAYS, Pair
from studies.runner.result import ITEMS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = MappingProxyType({SHIPPED: "#7b3fa0", BAYESIAN: "#c04a2b", ALLOCATION: "#1f7a4d"})
DIFFERENCES = (("h", "largest Δh"), ("time", "Δtime, s"), ("yaw", "largest Δyaw, rad"))  # of the paper's histograms
BINS = 20
NETWORKS = MappingProxyType({"LSTM-0.001": "#7b3fa0", "LSTM-0.01": "#1f7a4d", "LSTM-0.1": "#c0282b"})  # as in the paper
TOPPQUAD_STYLE = MappingProxyType({"color": "#2b5fc0", "ls": "--", "zorder": 2})
PANELS = 4  # panels of tracks in a row
EDGES = tuple((corner, corner | 1 << axis) for corner in range(8) for axis in range(3) if not corner & 1 << axis)
PATH_POINTS = 121  # points of a planned path


class Drawing(NamedTuple):
    """One figure: the study whose rows it shows, the type of a row, and the function that draws them."""

    study: str
    row: type
    draw: Callable[[Sequence[Any]], "Figure"]


class Written(NamedTuple):
    """A figure that was written or left out."""

    file: Path
    left_out: str  # why it was left out; empty if it was written


def write_figures(results: Path, images: Path, networks: Path) -> list[Written]:
    """Draw each of FIGURES from the rows in `results`, and the training of `networks`, and write them to `images`.

    Figures without rows or networks are left out; neither are kept in the repository.

    Raises:
        InputError: no such folder, or a figure that cannot be written.
    """
    if not images.is_dir():
        raise InputError("no such folder", where=str(images), hint="make it first")
    draw: dict[str, Callable[[], Figure]] = {name: partial(_draw, each, results) for name, each in FIGURES.items()}
    draw["paper-training"] = lambda: draw_training(read_logs(networks))
    written = []
    for name, drawn in draw.items():
        file = images / f"{name}.png"
        try:
            figure = drawn()
        except InputError as error:
            written.append(Written(file, str(error)))
            continue
        save_figure(figure, file, overwrite=True)
        written.append(Written(file, ""))
    return written


def _draw(drawing: Drawing, results: Path) -> "Figure":
    return drawing.draw(_read_rows(results, drawing.study, drawing.row))


def _read_rows(results: Path, study: str, row: type) -> list[Any]:
    """Return the rows of a study's cases. Raises InputError, with the command that makes them, if there are none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file, hint = results / ITEMS / f"{study}.parquet", f"make it: python -m studies {study} -o {results / study}.json"
    try:
        return [row(**fields) for fields in pq.read_table(file).to_pylist()]
    except OSError as error:
        raise InputError(error.strerror or "no rows of its cases", where=str(file), hint=hint) from None
    except (pa.ArrowInvalid, TypeError):
        raise InputError("not the rows of this study as it is", where=str(file), hint=hint) from None


def read_logs(networks: Path) -> dict[str, list[tuple[float, float]]]:
    """Return the validation loss and the learning rate of each epoch, by name of the trained networks of a folder.

    Raises InputError, with the command that trains them, if there are none.
    """
    logs = {}
    for folder in sorted(file.parent for file in networks.glob(f"*/{WEIGHTS}")):
        with (folder / LOG).open(newline="") as opened:
            logs[folder.name] = [(float(row["unseen_loss"]), float(row["rate"])) for row in csv.DictReader(opened)]
    if not logs:
        raise InputError("no trained networks", where=str(networks), hint="train them: python -m studies networks")
    return logs


def draw_training(logs: Mapping[str, Sequence[tuple[float, float]]]) -> "Figure":
    """Draw the validation loss of each network by epoch; dots mark the epochs at which the learning rate was cut."""
    from matplotlib.figure import Figure

    models: dict[str, list[str]] = {}  # names of the trainings, with different seeds, of each model
    for name in logs:
        models.setdefault(name.partition("-seed-")[0], []).append(name)
    lines = -(-len(models) // PANELS)
    figure = Figure(figsize=(2.6 * PANELS, 2.2 * lines), layout="constrained")
    grid = np.atleast_1d(figure.subplots(lines, PANELS, sharey=True)).ravel()
    for axes, (model, names) in zip(grid, models.items(), strict=False):
        for name in names:
            losses, rates = np.array(logs[name]).T
            (line,) = axes.semilogy(1 + np.arange(len(losses)), losses, lw=0.9)
            cuts = np.flatnonzero(np.diff(rates) < 0.0)
            axes.plot(1 + cuts, losses[cuts], ".", color=line.get_color())
        axes.set_title(model, fontsize=8)
        axes.tick_params(labelsize=6)
        axes.grid(alpha=0.25)
    for axes in grid[len(models) :]:
        axes.set_visible(False)
    return figure


def draw_baselines(rows: Sequence[BaselineTrial]) -> "Figure":
    """Draw the planners' paths through the same waypoints, and the boxes of the AllocNet baseline."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    seeds = list(dict.fromkeys(row.seed for row in rows if row.points))
    if not seeds:
        raise InputError("no path was flown by any planner of the figure", where="baselines", hint="measure more paths")
    figure = Figure(figsize=(3.2 * len(DRAWN), 2.6 * len(seeds)), layout=ConstrainedLayoutEngine(rect=(0, 0, 0.97, 1)))
    for line, seed in enumerate(seeds):
        motions = {row.planner: np.array(row.points) for row in rows if row.seed == seed and row.points}
        for column, name in enumerate(DRAWN):
            axes = figure.add_subplot(len(seeds), len(DRAWN), line * len(DRAWN) + column + 1, projection="3d")
            _draw_motion(axes, name, motions, seed)
            if line == 0:
                axes.set_title(name, fontsize=10)
    return figure


def _draw_motion(axes: Any, name: str, motions: Mapping[str, NDArray], seed: int) -> None:
    from matplotlib.ticker import MaxNLocator

    course = random_course(seed)
    waypoints, boxes = course.waypoints, box_corners(corridor_about(course.path))
    everything = np.concatenate([waypoints, *motions.values(), *boxes])
    if name == ALLOCATION:
        waypoints = waypoints[[0, -1]]  # it passes only these
        for box in boxes:
            for edge in EDGES:
                axes.plot(*box[list(edge)].T, color="0.55", lw=0.7)
    if name in motions:
        axes.plot(*motions[name].T, color=COLOURS[name], lw=1.6)
    axes.plot(*waypoints.T, "o", color="black", ms=3.5)
    for axis, label in ((axes.xaxis, "x, m"), (axes.yaxis, "y, m"), (axes.zaxis, "z, m")):
        axis.set_label_text(label, fontsize=7)
        axis.labelpad = -6.0
        axis.set_major_locator(MaxNLocator(4, integer=True))
    axes.tick_params(labelsize=6, pad=-3.0)
    axes.set(
        **dict(zip(("xlim", "ylim", "zlim"), np.stack([everything.min(0), everything.max(0)], axis=1), strict=True))
    )
    axes.set_aspect("equal")


def draw_yaw_consistency(rows: Sequence[Pair]) -> "Figure":
    """Draw histograms of the largest differences within pairs of paths, one row per planner."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    solved = [row for row in rows if row.solved]
    figure = Figure(figsize=(10.0, 2.3 * len(WAYS)), layout="constrained")
    grid = np.asarray(figure.subplots(len(WAYS), len(DIFFERENCES), sharex="col", sharey="col"))
    for column, (key, label) in enumerate(DIFFERENCES):
        bins = np.linspace(0.0, max((getattr(row, key) for row in solved), default=1.0), BINS + 1)
        for line, way in enumerate(WAYS):
            axes = grid[line, column]
            axes.hist([getattr(row, key) for row in solved if row.planner == way], bins, color="#4a6fa5")
            axes.grid(alpha=0.25)
            axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
            axes.set(xlabel=label if line == len(WAYS) - 1 else "", ylabel=f"{way}\npairs" if column == 0 else "")
    return figure


def draw_tracks(rows: Sequence[HardwareFlight], network: str) -> "Figure":
    """Draw the flights of a network and of TOPPQuad over their paths from above: as planned, then certified."""
    from matplotlib.figure import Figure

    rows = [row for row in rows if row.limits == TRACKED and row.path != LONG and row.planner in (TOPPQUAD, network)]
    paths = hardware_paths(load_limits(DEFAULTS), len({row.path for row in rows}))
    lines = -(-len(paths) // PANELS)
    figure = Figure(figsize=(2.4 * PANELS, 2 * 2.5 * lines), layout="constrained")
    parts = np.atleast_1d(np.asarray(figure.subfigures(2, 1))).tolist()
    for part, way in zip(parts, (RAW, CERTIFIED), strict=True):
        part.suptitle(f"{network}, {way}", fontsize=10)
        grid = np.atleast_1d(part.subplots(lines, PANELS)).ravel()
        for axes, (name, path) in zip(grid, paths.items(), strict=False):
            flights = [row for row in rows if (row.path, row.way) == (name, way)]
            axes.plot(*_places(path)[:, :2].T, "--", color="black", lw=0.9, zorder=3)
            for flight in flights:
                style = {"color": NETWORKS[network]} if flight.planner == network else TOPPQUAD_STYLE
                axes.plot(*_track(flight)[:, :2].T, lw=0.9, **style)
            own = [flight for flight in flights if flight.planner == network]
            lost = sum(map(failed, own))
            axes.set_title(f"path {name}" + (f": {lost} of {len(own)} failed" if lost else ""), fontsize=8)
            axes.set_aspect("equal")
            axes.tick_params(labelsize=6)
        for axes in grid[len(paths) :]:
            axes.set_visible(False)
    return figure


def draw_long(rows: Sequence[HardwareFlight]) -> "Figure":
    """Draw the shipped planner's certified flights over the long path, from above and from the side."""
    from matplotlib.figure import Figure

    flights = [row for row in rows if (row.limits, row.path, row.way) == (TRACKED, LONG, CERTIFIED)]
    if not any(flight.planner == SHIPPED for flight in flights):
        raise InputError(
            "no flight of the planner that ships over the long path", where="hardware", hint="leave --quick out"
        )
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    path = _places(long_path(load_limits(DEFAULTS)))
    for axes, (first, second) in zip(figure.subplots(1, 2), ((0, 1), (1, 2)), strict=True):
        axes.plot(path[:, first], path[:, second], "--", color="black", lw=0.9, zorder=3)
        for flight in flights:
            points, style = (
                _track(flight),
                TOPPQUAD_STYLE if flight.planner == TOPPQUAD else {"color": COLOURS[SHIPPED]},
            )
            axes.plot(points[:, first], points[:, second], lw=0.9, **style)
        axes.set(xlabel=f"{'xyz'[first]}, m", ylabel=f"{'xyz'[second]}, m")
        axes.set_aspect("equal")
    return figure


def _places(path: PathOfMotion) -> NDArray:
    """Return points along a path, (PATH_POINTS, 3) m."""
    return path(np.linspace(0.0, path.end, PATH_POINTS))


def _track(flight: HardwareFlight) -> NDArray:
    """Return the recorded positions of a flight, (N, 3) m."""
    return np.reshape(flight.points, (-1, 3)) / 1000.0


FIGURES: MappingProxyType[str, Drawing] = MappingProxyType({
    "paper-baselines": Drawing("baselines", BaselineTrial, draw_baselines),
    "paper-yaw": Drawing("yaw-consistency", Pair, draw_yaw_consistency),
    **{
        f"paper-{name}": Drawing("hardware", HardwareFlight, partial(draw_tracks, network=name)) for name in NETWORKS
    },
    "paper-long": Drawing("hardware", HardwareFlight, draw_long),
})  # fmt: skip
