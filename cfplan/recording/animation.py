"""A recorded flight as a GIF: the room in perspective, the path in the colours of its limits, the vehicle, its speed.

Drawn by Pillow alone, so it needs neither screen nor graphics driver. Each frame is drawn at twice its size and shrunk;
all have one palette, and a file holds what changes from frame to frame.
"""

from dataclasses import dataclass
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cfplan.files.whole import check_new_file, write_whole
from cfplan.planning.active_limits import FREE, FREE_COLOUR, LIMIT_COLOURS, Colour, active_limits, on_white
from cfplan.planning.plan_file import load_plan
from cfplan.planning.plan_result import Plan
from cfplan.recording.record import PLAN_FILE, Record
from cfplan.recording.summary import reference_span
from cfplan.safety.space import Space
from cfplan.vehicle.rotations import axes_of

if TYPE_CHECKING:
    from PIL import Image, ImageDraw

SUFFIX = ".gif"
WIDTH, HEIGHT = 720, 440  # pixels of a frame
RATE = 10  # frames a second, of the flight's own time
_FINE = 2  # times the size at which frames are drawn
_VIEW, _CURVE = (16, 34, 704, 336), (60, 352, 704, 414)  # pixels: left, top, right, bottom
_BEFORE, _AFTER = 0.5, 1.0  # s shown before the path and after it
_TAIL = 2.0  # s of the track that are thick
_ARM = 0.16  # m, four times as long as a Crazyflie's: in a room of 8 m it would be a dot
_ROTOR = 0.09  # m
_COLOURS = 128  # of the palette
_SWING, _RISE = np.radians(-32.0), np.radians(26.0)  # of the camera, from across the room
_AWAY = 2.6  # times the room's longest side
_WHITE, _GREY, _PALE, _DARK = (255, 255, 255), (150, 150, 150), (226, 228, 230), (30, 30, 30)
_FRONT, _FLOWN = (213, 60, 40), (20, 20, 20)


def animate_flight(record: Record) -> "list[Image.Image]":
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
    """Raise InputError where no animation can be written there."""
    check_new_file(file, SUFFIX, overwrite=overwrite)


def save_animation(frames: "list[Image.Image]", file: Path, *, overwrite: bool = False) -> None:
    """Write frames as a GIF that repeats, whole or not at all. Raises InputError where it cannot be written."""
    from PIL import Image

    check_animation_file(file, overwrite=overwrite)
    palette = frames[len(frames) // 2].quantize(_COLOURS, Image.Quantize.MAXCOVERAGE)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    content = BytesIO()
    few[0].save(content, "GIF", save_all=True, append_images=few[1:], duration=1000 // RATE, loop=0, optimize=True)
    write_whole(file, content.getvalue())


@dataclass(frozen=True, slots=True)
class _Camera:
    """A perspective view of a room that fills a rectangle of the frame."""

    eye: NDArray  # (3,) m
    axes: NDArray  # (3, 3): right, up and ahead
    scale: float  # pixels at a distance of 1
    centre: NDArray  # (2,) pixels

    @staticmethod
    def of(space: Space) -> "_Camera":
        """Return the view across the shorter side of a room, from above."""
        low, high = np.array(space.low), np.array(space.high)
        side = 0.0 if (high - low)[0] <= (high - low)[1] else -np.pi / 2
        swing = side + _SWING
        away = np.array([np.cos(swing) * np.cos(_RISE), np.sin(swing) * np.cos(_RISE), np.sin(_RISE)])
        eye = (low + high) / 2 + _AWAY * float((high - low).max()) * away
        right = np.array([-np.sin(swing), np.cos(swing), 0.0])
        axes = np.stack([right, np.cross(away, right), -away])
        view = _Camera(eye, axes, 1.0, np.zeros(2))
        corners = view.pixels(np.array(list(product(*zip(low, high, strict=True)))))
        least, most = corners.min(axis=0), corners.max(axis=0)
        room = np.array([_VIEW[2] - _VIEW[0], _VIEW[3] - _VIEW[1]])
        scale = float((room / (most - least)).min())
        middle = np.array([(_VIEW[0] + _VIEW[2]) / 2, (_VIEW[1] + _VIEW[3]) / 2])
        return _Camera(eye, axes, scale, middle - scale * (least + most) / 2)

    def pixels(self, points: NDArray) -> NDArray:
        """Return where points, (N, 3) m, are in the frame, (N, 2)."""
        right, up, ahead = self.axes @ (points - self.eye).T
        return self.scale * np.stack([right / ahead, -up / ahead], axis=1) + self.centre


class _Scene:
    """What stays the same from frame to frame, drawn once, and what moves."""

    def __init__(self, record: Record, plan: Plan, begin: float):
        self._record, self._plan, self._begin = record, plan, begin
        self._camera = _Camera.of(plan.limits.space)
        self._active = active_limits(plan)
        self._speed = np.linalg.norm(record.estimates.velocity, axis=1)
        self._span = -_BEFORE, plan.trajectory.duration + _AFTER
        self._most = 1.1 * plan.limits.plan.speed
        self._still = self._draw_still()

    def frame(self, moment: float) -> "Image.Image":
        """Return the frame of a moment, s on the record's clock."""
        from PIL import Image, ImageDraw

        image = self._still.copy()
        draw = ImageDraw.Draw(image)
        poses = self._record.poses
        now = int(np.searchsorted(poses.time, moment, side="right")) - 1
        early, tail = np.searchsorted(poses.time, [self._begin - _BEFORE, moment - _TAIL])
        self._line(draw, poses.position[early : now + 1 : 2], _FLOWN, 1)
        self._line(draw, poses.position[max(tail, early) : now + 1], _FLOWN, 2)
        self._draw_vehicle(draw, poses.position[now], poses.quaternion[now])
        self._draw_speed(draw, moment)
        return image.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)

    def _draw_still(self) -> "Image.Image":
        from PIL import Image, ImageDraw

        image = Image.new("RGB", (_FINE * WIDTH, _FINE * HEIGHT), _WHITE)
        draw, space = ImageDraw.Draw(image), self._plan.limits.space
        low, high = np.array(space.low), np.array(space.high)
        for axis in (0, 1):
            for at in np.arange(np.ceil(low[axis]), high[axis] + 1e-9):
                ends = np.array([low, high])
                ends[:, 2], ends[:, axis] = low[2], at
                self._line(draw, ends, _PALE, 1)
        corners = np.array(list(product(*zip(low, high, strict=True))))
        for a, b in product(range(8), range(8)):
            if a < b and int(np.count_nonzero(corners[a] != corners[b])) == 1:
                self._line(draw, corners[[a, b]], _GREY, 1)
        floor = self._active.position.copy()
        floor[:, 2] = low[2]
        self._line(draw, floor[::4], (205, 205, 205), 2)
        for name, rows in self._active.stretches():
            self._line(draw, self._active.position[rows], _colour(name), 4)
        self._draw_words(draw)
        self._draw_curve(draw)
        return image

    def _draw_words(self, draw: "ImageDraw.ImageDraw") -> None:
        plan = self._plan
        said = f"{plan.path.length:.1f} m in {plan.trajectory.duration:.2f} s, {plan.airframe.name}"
        self._text(draw, (16, 10), f"{self._record.header.name}: {said}", 15)
        place = 16
        for name in [*dict.fromkeys(str(name) for name in self._active.name if name != FREE)]:
            self._text(draw, (place + 22, HEIGHT - 18), name, 11, _GREY)
            draw.line([_FINE * place, _FINE * (HEIGHT - 11), _FINE * (place + 16), _FINE * (HEIGHT - 11)],
                      fill=_colour(name), width=4 * _FINE)  # fmt: skip
            place += 34 + 7 * len(name)

    def _draw_curve(self, draw: "ImageDraw.ImageDraw") -> None:
        """Draw the plan's speed over time, and its limit."""
        left, _, right, bottom = _CURVE
        limit = self._height_of(self._plan.limits.plan.speed)
        self._text(draw, (16, limit - 7), f"{self._plan.limits.plan.speed:g} m/s", 11, _GREY)
        for place in range(left, right, 12):
            draw.line([_FINE * place, _FINE * limit, _FINE * (place + 6), _FINE * limit], fill=_GREY, width=_FINE)
        draw.line([_FINE * left, _FINE * bottom, _FINE * right, _FINE * bottom], fill=_GREY, width=_FINE)
        speed = np.linalg.norm(self._plan.trajectory.at(self._active.time).velocity, axis=1)
        self._curve(draw, self._active.time, speed, (190, 190, 190), 3)

    def _draw_speed(self, draw: "ImageDraw.ImageDraw", moment: float) -> None:
        estimates, now = self._record.estimates, moment - self._begin
        flown = (estimates.time >= self._begin + self._span[0]) & (estimates.time <= moment)
        if flown.any():
            self._curve(draw, estimates.time[flown] - self._begin, self._speed[flown], _FLOWN, 1)
            x, y = self._across(now), self._height_of(float(self._speed[flown][-1]))
            draw.ellipse([_FINE * (x - 3), _FINE * (y - 3), _FINE * (x + 3), _FINE * (y + 3)], fill=_FRONT)
            self._text(draw, (WIDTH - 128, 10), f"{max(now, 0.0):4.1f} s  {self._speed[flown][-1]:.1f} m/s", 15)

    def _draw_vehicle(self, draw: "ImageDraw.ImageDraw", position: NDArray, quaternion: NDArray) -> None:
        """Draw arms and rotors, red in front, and a line down to the floor."""
        below = position.copy()
        below[2] = self._plan.limits.space.low[2]
        self._line(draw, np.array([position, below]), _GREY, 1)
        x, y, _ = (np.array(axis) for axis in axes_of(*quaternion))
        turn = np.linspace(0.0, 2 * np.pi, 17)
        circle = _ROTOR * (np.outer(np.cos(turn), x) + np.outer(np.sin(turn), y))
        for along, aside in product((1, -1), (1, -1)):
            tip = position + _ARM * (along * x + aside * y) / np.sqrt(2.0)
            self._line(draw, np.array([position, tip]), _FLOWN, 3)
            self._line(draw, tip + circle, _FRONT if along > 0 else _FLOWN, 2)

    def _curve(self, draw: "ImageDraw.ImageDraw", time: NDArray, speed: NDArray, colour: Colour, width: int) -> None:
        points = [(_FINE * self._across(t), _FINE * self._height_of(v)) for t, v in zip(time, speed, strict=True)]
        draw.line(points, fill=colour, width=width * _FINE)

    def _across(self, time: float) -> float:
        begin, end = self._span
        return float(_CURVE[0] + (_CURVE[2] - _CURVE[0]) * np.clip((time - begin) / (end - begin), 0.0, 1.0))

    def _height_of(self, speed: float) -> float:
        return float(_CURVE[3] - (_CURVE[3] - _CURVE[1]) * np.clip(speed / self._most, 0.0, 1.0))

    def _line(self, draw: "ImageDraw.ImageDraw", points: NDArray, colour: Colour, width: int) -> None:
        if len(points) > 1:
            pixels = _FINE * self._camera.pixels(points)
            draw.line([(x, y) for x, y in pixels.tolist()], fill=colour, width=width * _FINE, joint="curve")

    def _text(
        self, draw: "ImageDraw.ImageDraw", place: tuple[float, float], text: str, size: int, colour: Colour = _DARK
    ) -> None:
        from PIL import ImageFont

        font = ImageFont.load_default(_FINE * size)
        draw.text((_FINE * place[0], _FINE * place[1]), text, fill=colour, font=font)


def _colour(name: str) -> Colour:
    return on_white(FREE_COLOUR if name == FREE else LIMIT_COLOURS[name])
