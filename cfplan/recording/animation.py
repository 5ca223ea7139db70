"""A recorded flight as a GIF: the room in perspective, the path in the colours of its limits, the vehicle, its speed.

The static background is drawn once, and in each frame the moving parts over it. All frames share one palette, and the
file stores the differences between frames.
"""

from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from PIL import Image

from cfplan.files.atomic import check_new_file, write_atomically
from cfplan.planning.active_limits import FREE, active_limits
from cfplan.planning.figure import FLOWN, OBSTACLE, caption, draw_path, draw_speed, limit_colour
from cfplan.planning.plan_file import load_plan
from cfplan.planning.plan_result import Plan
from cfplan.recording.record import PLAN_FILE, Record
from cfplan.recording.summary import reference_span
from cfplan.safety.space import Obstacle, Space, outline
from cfplan.vehicle.rotations import matrix_of

SUFFIX = ".gif"
WIDTH, HEIGHT = 720, 440  # pixels of a frame
RATE = 10  # frames a second, of the flight's own time
_DPI = 100  # pixels an inch
_VIEW, _CURVE = (0.08, 0.33, 0.84, 0.51), (0.07, 0.1, 0.91, 0.13)  # of a frame: left, bottom, width, height
_BEFORE, _AFTER = 0.5, 1.0  # s shown before the path and after it
_TAIL = 2.0  # s of the track that are thick
_COLOURS = 128  # of the palette
_STYLE: dict[Any, Any] = {
    "axes.spines.right": False, "axes.spines.top": False, "axes.labelpad": 6, "font.size": 8, "grid.color": "0.85",
    "grid.linewidth": 0.6,
    **{f"axes3d.{axis}axis.panecolor": "white" for axis in "xyz"},
}  # fmt: skip
_SWING, _RISE = -32.0, 26.0  # degrees, of the camera, from across the shorter side of a room
_FOCAL_LENGTH = 0.42  # of matplotlib's camera, which then stands 2.2 diagonals of the room away
_FRONT, _PALE = "#d53c28", "0.8"
_ARM, _ROTOR = 0.16, 0.09  # m; an arm is four times as long as a Crazyflie's: in a room of 8 m it would be a dot
_TIPS = _ARM / np.sqrt(2.0) * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])  # (4, 3) m, on the body
_TURN = np.append(np.linspace(0.0, 2.0 * np.pi, 17), np.nan)  # NaN, for a line that breaks
_ROTORS = _TIPS[:, None] + _ROTOR * np.stack([np.cos(_TURN), np.sin(_TURN), 0.0 * _TURN], axis=1)  # (4, 18, 3) m
_VEHICLE = (  # lines on the body in m, their colours and widths
    (_TIPS[[0, 3]], FLOWN, 1.6),
    (_TIPS[[1, 2]], FLOWN, 1.6),
    (np.concatenate(_ROTORS[2:]), FLOWN, 1.2),
    (np.concatenate(_ROTORS[:2]), _FRONT, 1.2),
)


def animate_flight(record: Record) -> list[Image.Image]:
    """Return the frames of a flight along its plan, RATE a second.

    Raises:
        InputError: there is no plan beside the record, or nothing of it was flown.
    """
    plan = load_plan(record.folder / PLAN_FILE)
    begin, end = reference_span(record)
    scene = _Scene(record, plan, begin)
    first, last = max(begin - _BEFORE, record.poses.time[0]), min(end + _AFTER, record.poses.time[-1])
    return [scene.frame(moment) for moment in np.arange(first, last, 1.0 / RATE)]


def check_animation_file(file: Path, *, overwrite: bool) -> None:
    """Raise InputError if no animation can be written there."""
    check_new_file(file, SUFFIX, overwrite=overwrite)


def save_animation(frames: list[Image.Image], file: Path, *, overwrite: bool = False) -> None:
    """Write frames as a looping GIF, atomically. Raises InputError if it cannot be written."""
    check_animation_file(file, overwrite=overwrite)
    palette = frames[len(frames) // 2].quantize(_COLOURS, Image.Quantize.MAXCOVERAGE)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    content = BytesIO()
    few[0].save(content, "GIF", save_all=True, append_images=few[1:], duration=1000 // RATE, loop=0, optimize=True)
    write_atomically(file, content.getvalue())


class _Scene:
    """The static background, drawn once, and the moving parts."""

    @mpl.rc_context(_STYLE)
    def __init__(self, record: Record, plan: Plan, begin: float):
        self._record, self._begin, self._floor = record, begin, plan.limits.space.low[2]
        self._speed = np.linalg.norm(record.estimates.velocity, axis=1)
        figure = Figure(figsize=(WIDTH / _DPI, HEIGHT / _DPI), dpi=_DPI)
        self._canvas = FigureCanvasAgg(figure)
        room, curve = _draw_still(figure, plan, record.header.name)
        moving: dict[str, Any] = {"animated": True}  # left out when the canvas is drawn
        self._track, self._tail, self._plumb, *self._vehicle = (
            room.plot([], [], [], color=colour, lw=width, **moving)[0]
            for colour, width in ((FLOWN, 0.6), (FLOWN, 1.2), ("0.6", 0.7), *((c, w) for _, c, w in _VEHICLE))
        )
        (self._flown,) = curve.plot([], [], color=FLOWN, lw=0.8, **moving)
        (self._now,) = curve.plot([], [], "o", color=_FRONT, ms=4, **moving)
        self._clock = figure.text(0.98, 0.94, "", size=10, ha="right", **moving)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)

    def frame(self, moment: float) -> Image.Image:
        """Return the frame of a moment, s on the record's clock."""
        poses, estimates = self._record.poses, self._record.estimates
        now = int(np.searchsorted(poses.time, moment, side="right")) - 1
        early, tail = np.searchsorted(poses.time, [self._begin - _BEFORE, moment - _TAIL])
        self._track.set_data_3d(*poses.position[early : now + 1 : 2].T)
        self._tail.set_data_3d(*poses.position[max(tail, early) : now + 1].T)
        x, y, z = poses.position[now]
        self._plumb.set_data_3d([x, x], [y, y], [z, self._floor])
        for line, (points, _, _) in zip(self._vehicle, _VEHICLE, strict=True):
            line.set_data_3d(*(poses.position[now] + points @ matrix_of(poses.quaternion[now]).T).T)
        flown = (estimates.time >= self._begin - _BEFORE) & (estimates.time <= moment)
        time, speed = estimates.time[flown] - self._begin, self._speed[flown]
        self._flown.set_data(time, speed)
        self._now.set_data(time[-1:], speed[-1:])
        self._clock.set_text(f"{max(moment - self._begin, 0.0):4.1f} s  {speed[-1]:.1f} m/s" if len(speed) else "")
        self._canvas.restore_region(self._still)
        for artist in (self._track, self._tail, self._plumb, *self._vehicle, self._flown, self._now, self._clock):
            artist.draw(self._canvas.get_renderer())
        return Image.fromarray(np.array(self._canvas.buffer_rgba())).convert("RGB")


def _draw_still(figure: Figure, plan: Plan, name: str) -> tuple[Any, Axes]:
    """Draw the static background; return the axes of the room and of the speed."""
    active = active_limits(plan)
    figure.text(0.02, 0.94, caption(plan, name), size=10, parse_math=False)
    limits = dict.fromkeys(str(name) for name in active.name if name != FREE)
    handles = [Line2D([], [], color=limit_colour(limit), lw=2.6, label=limit) for limit in limits]
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.01, 0.94), ncols=5, fontsize=7, frameon=False)
    room = _draw_room(figure, plan.limits.space)
    for obstacle in plan.limits.space.obstacles:
        _draw_obstacle(room, obstacle)
    room.plot(*active.position[:, :2].T, plan.limits.space.low[2], color=_PALE, lw=1.4)
    draw_path(room, active, 0, 1, 2)
    curve = figure.add_axes(_CURVE, xlim=(-_BEFORE, plan.trajectory.duration + _AFTER))
    draw_speed(curve, plan, active)
    curve.set(xlabel="time, s", ylim=(0.0, 1.1 * plan.limits.plan.speed))
    return room, curve


def _draw_obstacle(room: Any, obstacle: Obstacle) -> None:
    """Draw foot, top and upright edges of an obstacle."""
    around, (_, _, z, _, _, tall, _, _) = outline(obstacle), obstacle.prism
    for height in (z - tall, z + tall):
        room.plot(*around.T, height, color=OBSTACLE, lw=1.0)
    for x, y in around[:: max(len(around) // 4, 1)]:
        room.plot([x, x], [y, y], [z - tall, z + tall], color=OBSTACLE, lw=1.0)


def _draw_room(figure: Figure, space: Space) -> Any:
    """Return three-dimensional axes that show the room, with equal scales, as large as fits the view."""
    low, high = np.array(space.low), np.array(space.high)
    room: Any = figure.add_axes((0.0, 0.0, HEIGHT / WIDTH, 1.0), projection="3d")
    room.set_proj_type("persp", _FOCAL_LENGTH)
    room.view_init(_RISE, _SWING - (0.0 if (high - low)[0] <= (high - low)[1] else 90.0))
    room.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
    room.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    room.set_box_aspect(high - low)
    for axis in (room.xaxis, room.yaxis, room.zaxis):
        axis.set_major_locator(MaxNLocator(9, integer=True))
    corners = [(*corner, 1.0) for corner in product(*zip(low, high, strict=True))]
    x, y, _, away = room.get_proj() @ np.transpose(corners)
    drawn = (room.transData - figure.transFigure).transform(np.stack([x / away, y / away], axis=1))
    least, most = drawn.min(axis=0), drawn.max(axis=0)
    scale = float(np.min(_VIEW[2:] / (most - least)))
    left, bottom = np.array(_VIEW[:2]) + 0.5 * np.array(_VIEW[2:]) - 0.5 * scale * (least + most)
    room.set_position((left, bottom, scale * HEIGHT / WIDTH, scale))
    return room
