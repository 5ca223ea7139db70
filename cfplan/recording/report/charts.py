"""Draw charts with matplotlib: lines over time with their limits, and positions seen from above or from a side.

Each is a figure of the page: the drawing is SVG; title and legend are HTML, which can show any name.
"""

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cfplan.planning.active_limits import on_white
from cfplan.recording.plots import LIMIT, Colour, near_limits

WIDTH, HEIGHT = 496.0, 170.0  # points, of the area inside the axes
LEFT, RIGHT, TOP, BOTTOM = 52.0, 12.0, 8.0, 34.0  # points around it
LOWEST, TALLEST = 60.0, 320.0  # points, height of a chart of positions
NARROWEST = 1.0  # m, least width of a chart of positions, so that millimetres of noise do not fill it
_BAND, _GRID, _TEXT = "#f3f6fb", "#e3e3e3", "#444"
_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True, "axes.grid": True, "axes.labelcolor": _TEXT, "axes.xmargin": 0.0, "grid.color": _GRID,
    "font.family": "sans-serif", "font.sans-serif": "DejaVu Sans", "font.size": 11,
    "lines.linewidth": 1.4, "path.simplify_threshold": 0.5, "svg.fonttype": "none", "svg.hashsalt": "cfplan",
    "xaxis.labellocation": "right", "xtick.color": _TEXT, "ytick.color": _TEXT,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    **{f"{axis}tick.major.size": 0 for axis in "xy"},
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One line of a chart; NaN breaks it."""

    label: str
    x: NDArray  # (N,)
    y: NDArray  # (N,)
    colour: Colour
    dashed: bool = False


@mpl.rc_context(_STYLE)
def time_chart(
    title: str,
    curves: Sequence[Curve],
    *,
    limits: Sequence[float] = (),
    band: tuple[float, float] | None = None,
    span: tuple[float, float] | None = None,
) -> str:
    """Draw curves over time in s, limits as horizontal lines, and the time along the path as a shaded band.

    The axis shows the times in `span`, or all. A limit far above all measured values is only named in the legend, as
    drawing it would flatten the curves.
    """
    figure, axes = _axes(curves, HEIGHT)
    values = [curve.y for curve in curves]
    near = near_limits(limits, values)
    for limit in near:
        axes.axhline(limit, color=on_white(LIMIT), linewidth=1.0, dashes=(6, 3))
    if band is not None:
        axes.axvspan(*band, color=_BAND, zorder=0)
    if min(*_range(values), *near) == 0.0:
        axes.set_ylim(bottom=0.0)
    axes.set(xlim=span, xlabel="time, s")
    named = [("limit", LIMIT, True)] * bool(near)
    named += [(f"limit {limit:g} (off the chart)", LIMIT, True) for limit in limits if limit not in near]
    return _figure(title, curves, named, figure)


@mpl.rc_context(_STYLE)
def place_chart(title: str, curves: Sequence[Curve], names: tuple[str, str]) -> str:
    """Draw curves in m over m, with the same scale on both axes."""
    ranges = np.array([_range([curve.x for curve in curves]), _range([curve.y for curve in curves])])
    wide, high = np.maximum(1.1 * np.ptp(ranges, axis=1), (NARROWEST, 0.0))
    tall = float(np.clip(high / wide * WIDTH, LOWEST, TALLEST))
    figure, axes = _axes(curves, tall)
    scale = max(wide / WIDTH, high / tall)  # m a point
    half = 0.5 * scale * np.array([WIDTH, tall])
    (left, bottom), (right, top) = ranges.mean(axis=1) - half, ranges.mean(axis=1) + half
    axes.set(xlim=(left, right), ylim=(bottom, top), xlabel=f"{names[0]}, m")
    axes.set_ylabel(f"{names[1]}, m")
    return _figure(title, curves, [], figure)


def _range(arrays: Sequence[NDArray]) -> tuple[float, float]:
    values = np.concatenate([array[np.isfinite(array)] for array in arrays] or [np.empty(0)])
    return (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)


def _axes(curves: Sequence[Curve], tall: float) -> tuple[Figure, Axes]:
    """Return a figure and its axes of WIDTH by `tall` points with the curves."""
    width, height = WIDTH + LEFT + RIGHT, tall + TOP + BOTTOM
    figure = Figure(figsize=(width / 72, height / 72), facecolor="none")
    axes = figure.add_axes((LEFT / width, BOTTOM / height, WIDTH / width, tall / height), facecolor="none")
    for curve in curves:
        axes.plot(curve.x, curve.y, color=on_white(curve.colour), linestyle="--" if curve.dashed else "-")
    return figure, axes


def _figure(title: str, curves: Sequence[Curve], named: Sequence[tuple[str, Colour, bool]], figure: Figure) -> str:
    """Return the chart with its title and legend."""
    entries = dict.fromkeys([*((curve.label, curve.colour, curve.dashed) for curve in curves), *named])
    legend = "".join(
        f'<span><i style="border-top: 3px {"dashed" if dashed else "solid"} {on_white(colour)}"></i>'
        f"{html.escape(label)}</span>"
        for label, colour, dashed in entries
    )
    file = StringIO()
    figure.savefig(file, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    svg = file.getvalue()
    svg = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d)\d+", r"\1", path[0]), svg[svg.index("<svg") :])
    return f"<figure><figcaption><b>{html.escape(title)}</b>{legend}</figcaption>{svg}</figure>"
