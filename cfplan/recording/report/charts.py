"""Draw charts as SVG text: lines over time with their limits, and places seen from above or from a side.

A browser alone shows them. Where there are more points than pixels, the least and the largest of each
pixel's width are drawn, so that no spike is lost.
"""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.numbers import shown
from cfplan.planning.active_limits import on_white
from cfplan.recording.plots import FAR_LIMIT, LIMIT, Colour

WIDTH, HEIGHT = 560, 250  # of a chart, in its own units
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 46, 34  # around what is drawn
TALLEST = 320.0  # of a chart of places
NARROWEST = 1.0  # m across a chart of places, or millimetres of noise would fill it
_SMALLEST_SPAN = 1e-9  # of the values, or of 1: smaller ones cannot be told apart
COLUMNS = 400  # pixels across a chart, within which points cannot be distinguished
_LETTER = 6.2  # width of one, about
_LEGEND_ROW = 15.0  # height of each row of the legend behind the first
_GRID, _TEXT, _BAND = "#e3e3e3", "#444", "#f3f6fb"


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One line of a chart; NaN breaks it."""

    label: str
    x: NDArray  # (N,)
    y: NDArray  # (N,)
    colour: Colour
    dashed: bool = False


def time_chart(
    title: str,
    curves: Sequence[Curve],
    *,
    limits: Sequence[float] = (),
    band: tuple[float, float] | None = None,
    span: tuple[float, float] | None = None,
) -> str:
    """Draw curves over time in s, the limits as level lines, the band (the time along the path) shaded.

    The axis shows the times in `span`, or those that there are. A limit far above all measured values is named, not
    drawn, or nothing else could be seen.
    """
    x = _span([curve.x for curve in curves]) if span is None else span
    y = _span([curve.y for curve in curves])
    reach = FAR_LIMIT * (y[1] - y[0])
    near = [limit for limit in limits if y[0] - reach <= limit <= y[1] + reach]
    far = [limit for limit in limits if limit not in near]
    low, high = _padded(min([y[0], *near]), max([y[1], *near]))
    frame = _Frame(x[0], x[1], low, high, WIDTH, HEIGHT)
    parts = []
    if band is not None:
        begin, end = (min(max(frame.x(np.array(edge)).item(), LEFT), WIDTH - RIGHT) for edge in band)
        height = HEIGHT - TOP - BOTTOM
        parts.append(f'<rect x="{begin:.1f}" y="{TOP}" width="{end - begin:.1f}" height="{height}" fill="{_BAND}"/>')
    parts.append(_grid(frame, "s"))
    parts += [_line(frame, curve) for curve in curves]
    for limit in near:
        height = frame.y(np.array(limit)).item()
        parts.append(
            f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{height:.1f}" y2="{height:.1f}" '
            f'stroke="{_css(LIMIT)}" stroke-dasharray="6 3"/>'
        )
    labels = [(curve.label, curve.colour, curve.dashed) for curve in curves]
    labels += [("limit", LIMIT, True)] * bool(near) + [
        (f"limit {limit:g} (off the chart)", LIMIT, True) for limit in far
    ]
    return _svg(title, labels, parts, WIDTH, HEIGHT)


def place_chart(title: str, curves: Sequence[Curve], axes: tuple[str, str]) -> str:
    """Draw curves in m over m, both axes to the same scale."""
    x, y = _span([curve.x for curve in curves]), _span([curve.y for curve in curves])
    (left, right), (low, high) = _padded(*x), _padded(*y)
    narrow = max(NARROWEST - (right - left), 0.0) / 2
    left, right = left - narrow, right + narrow
    across = WIDTH - LEFT - RIGHT
    tall = min(max((high - low) / (right - left) * across, 60.0), TALLEST)
    height = tall + TOP + BOTTOM
    scale = min(across / (right - left), tall / (high - low))
    spare = (across / scale - (right - left)) / 2
    rise = (tall / scale - (high - low)) / 2
    frame = _Frame(left - spare, right + spare, low - rise, high + rise, WIDTH, height)
    parts = [_grid(frame, f"{axes[0]}, m", axes[1] + ", m"), *(_line(frame, curve) for curve in curves)]
    labels = [(curve.label, curve.colour, curve.dashed) for curve in curves]
    return _svg(title, labels, parts, WIDTH, height)


@dataclass(frozen=True, slots=True)
class _Frame:
    """The mapping from values to places in the chart."""

    left: float
    right: float
    low: float
    high: float
    width: float
    height: float

    def x(self, values: NDArray) -> NDArray:
        return LEFT + (values - self.left) / (self.right - self.left) * (self.width - LEFT - RIGHT)

    def y(self, values: NDArray) -> NDArray:
        return self.height - BOTTOM - (values - self.low) / (self.high - self.low) * (self.height - TOP - BOTTOM)


def _span(arrays: Sequence[NDArray]) -> tuple[float, float]:
    values = np.concatenate([np.ravel(array[np.isfinite(array)]) for array in arrays] or [np.empty(0)])
    if len(values) == 0:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    told_apart = high - low > _SMALLEST_SPAN * max(1.0, abs(low), abs(high))
    return (low, high) if told_apart else (low - 0.5, high + 0.5)


def _padded(low: float, high: float) -> tuple[float, float]:
    """Return the range with some room around it; a range that begins at zero still does."""
    room = 0.05 * (high - low)
    return (0.0 if low == 0 else low - room), high + room


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Return round numbers between low and high, about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def _grid(frame: _Frame, x_label: str, y_label: str = "") -> str:
    bottom, right = frame.height - BOTTOM, frame.width - RIGHT
    parts = []
    for value in ticks(frame.left, frame.right, 8):
        x = frame.x(np.array(value)).item()
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom:.1f}" stroke="{_GRID}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{_label(value)}</text>')
    for value in ticks(frame.low, frame.high, 5):
        y = frame.y(np.array(value)).item()
        parts.append(f'<line x1="{LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}" stroke="{_GRID}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_label(value)}</text>')
    parts.append(f'<text x="{right}" y="{bottom + 29:.1f}" text-anchor="end">{html.escape(x_label)}</text>')
    parts.append(f'<text x="6" y="{TOP - 6}">{html.escape(y_label)}</text>' if y_label else "")
    return "".join(parts)


def _label(value: float) -> str:
    return shown(value, ".6g")


def _line(frame: _Frame, curve: Curve) -> str:
    """Draw a curve that begins anew after every gap."""
    rows = thinned(curve.x, curve.y, COLUMNS) if _rising(curve.x) else np.arange(len(curve.x))
    x, y = frame.x(curve.x[rows]), frame.y(curve.y[rows])
    known = np.isfinite(x) & np.isfinite(y)
    begins = known & ~np.r_[False, known[:-1]]
    path = "".join(
        f"{'M' if begin else 'L'}{a:.1f} {b:.1f}" for a, b, begin, draw in zip(x, y, begins, known, strict=True) if draw
    )
    dash = ' stroke-dasharray="5 4"' if curve.dashed else ""
    return f'<path d="{path}" fill="none" stroke="{_css(curve.colour)}" stroke-width="1.4"{dash}/>'


def _rising(x: NDArray) -> bool:
    return bool(np.all(np.diff(x) >= 0))


def thinned(x: NDArray, y: NDArray, columns: int) -> NDArray:
    """Return rows enough to draw y over rising x: of each column the first, last, least, largest, and a gap."""
    if len(x) <= 4 * columns:
        return np.arange(len(x))
    width = (x[-1] - x[0]) / columns
    column = np.minimum(((x - x[0]) / width).astype(int), columns - 1) if width > 0 else np.zeros(len(x), dtype=int)
    firsts = np.flatnonzero(np.r_[True, np.diff(column) > 0])
    lasts = np.r_[firsts[1:], len(x)] - 1
    unknown = ~np.isfinite(y)
    least = np.lexsort((np.where(unknown, np.inf, y), column))[firsts]
    largest = np.lexsort((np.where(unknown, -np.inf, y), column))[lasts]
    gaps = np.flatnonzero(unknown)
    gaps = gaps[np.unique(column[gaps], return_index=True)[1]]
    return np.unique(np.concatenate([firsts, lasts, least, largest, gaps]))


def _svg(
    title: str, labels: Sequence[tuple[str, Colour, bool]], parts: Sequence[str], width: float, height: float
) -> str:
    legend, x, y = [], float(LEFT), 0.0
    longest = int((width - LEFT - RIGHT - 30) / _LETTER)
    for name, colour, dashed in dict.fromkeys(labels):
        label = _shortened(name, longest)
        if x > LEFT and x + 30 + _LETTER * len(label) > width - RIGHT:  # another row
            x, y = float(LEFT), y + _LEGEND_ROW
        dash = ' stroke-dasharray="5 3"' if dashed else ""
        legend.append(
            f'<line x1="{x:.0f}" x2="{x + 14:.0f}" y1="{y + 32:g}" y2="{y + 32:g}" stroke="{_css(colour)}" '
            f'stroke-width="3"{dash}/><text x="{x + 18:.0f}" y="{y + 36:g}">{html.escape(label)}</text>'
        )
        x += 30 + _LETTER * len(label)
    return (
        f'<svg viewBox="0 0 {width:g} {height + y:.0f}" role="img" xmlns="http://www.w3.org/2000/svg" '
        f'font-size="11" fill="{_TEXT}"><title>{html.escape(title)}</title>'
        f'<text x="{LEFT}" y="16" font-size="13" font-weight="600">{html.escape(title)}</text>'
        f'{"".join(legend)}<g transform="translate(0 {y:g})">{"".join(parts)}</g></svg>'
    )


def _shortened(label: str, letters: int) -> str:
    return label if len(label) <= letters else label[: max(letters - 1, 1)] + "…"


def _css(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*on_white(colour))
