"""Path files, path.yaml: which curve to fly, where in the room, with which yaw.

name: figure eight
waypoints: [[0, 0, 1], [1, 1, 1], …]    # or  points: file.csv  (waypoints, x, y, z a row)
                                        # or  curve: file.csv  (samples of a curve, x, y, z a row)
                                        # or  polynomials: file.csv  (as Crazyswarm writes them)
                                        # or  samples: file.csv  (t, x, y, z a row; the way is kept, the timing not)
shape: fastest                          # of waypoints: segment times are chosen when planning; min-snap if left out
yaw: {mode: fixed, angle_deg: 30}       # or  yaw: tangent,  yaw: free;  fixed at 0 if left out
laps: 3                                 # of a closed path, flown through without a stop
speed: 0.5                              # speed factor: 1 is as fast as the limits allow
place: {x: 0, y: 0, z: 0, yaw_deg: 90}  # turned about z through the origin, then moved; a fixed yaw turns too
"""

import math
import pathlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from cfplan.errors import InputError
from cfplan.files.text import read_named_table
from cfplan.files.yaml_with_places import HINT, Places, read_yaml_with_places
from cfplan.geometry.min_snap import (
    MIN_DENSE_SPACING,
    MIN_SPACING,
    REMOVE_HINT,
    check_points,
    min_snap,
    smooth_through,
)
from cfplan.geometry.path import Path, rotation_about_z
from cfplan.geometry.polynomial_csv import read_polynomials
from cfplan.geometry.timed_samples import timed_samples
from cfplan.geometry.yaw import YawMode

_LEAST_SAMPLED = 4  # points that a smooth path with free ends needs
_MANY_WAYPOINTS = 50  # rows of `points`: more are rather samples of a curve
_MAX_POINTS = 50_000  # over all laps
_POINTS_HINT = "give x, y, z in metres, as [[0, 0, 1], [1, 0, 1]]"


class PathShape(StrEnum):
    """Which curve leads through waypoints."""

    MIN_SNAP = "min-snap"  # with segment times like the straight lengths
    FASTEST = "fastest"  # with segment times chosen for the shortest flight, see planning/fastest_path.py


@dataclass(frozen=True, slots=True)
class PathFile:
    """A path file's content, checked and placed in the room."""

    name: str
    path: Path  # in the frame of the room; of min-snap shape until planning chooses another
    yaw: YawMode
    yaw_angle: float  # rad, in the frame of the room, in mode fixed; otherwise 0
    speed: float  # speed factor in (0, 1]; 1 is not slowed
    laps: int
    waypoints: NDArray  # (K, 3) m, in the frame of the room, all laps
    source: pathlib.Path
    losses: tuple[str, ...] = ()  # what the path does not keep or mistakes in what was given, a few words each
    shape: PathShape = PathShape.MIN_SNAP


class _Yaw(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    mode: YawMode
    angle_deg: float = Field(default=0.0, ge=-360.0, le=360.0)


class _Place(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw_deg: float = Field(default=0.0, ge=-360.0, le=360.0)


def _short_yaw(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        raise ValueError(f"a mode is needed beside the angle{HINT}write `yaw: {{mode: fixed, angle_deg: {value:g}}}`")
    return {"mode": value} if isinstance(value, str) else value


def _share(value: Any) -> Any:
    if isinstance(value, str) or (isinstance(value, int | float) and value > 1):
        raise ValueError(
            f"a share of the speed that the limits allow, above 0 and at most 1, not a speed in m/s{HINT}"
            "write 0.5 to fly half as fast; m/s stand in safety.yaml, `plan: speed`"
        )
    return value


class _Content(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(default="", max_length=100, pattern=r"^[^\n\r]*$")
    waypoints: list[list[float]] | None = None
    points: str | None = None
    curve: str | None = None
    polynomials: str | None = None
    samples: str | None = None
    shape: PathShape = PathShape.MIN_SNAP
    yaw: Annotated[_Yaw, BeforeValidator(_short_yaw)] = _Yaw(mode=YawMode.FIXED)
    laps: int = Field(default=1, ge=1, le=1000)
    speed: Annotated[float, Field(gt=0.0, le=1.0), BeforeValidator(_share)] = 1.0
    place: _Place = _Place()


def load_path_file(file: pathlib.Path | str) -> PathFile:
    """Read a path.yaml, and check that its path can be flown without a stop.

    Raises:
        InputError: a mistake in it or in the file that it names; names line and column.
    """
    file = pathlib.Path(file)
    content, places = read_yaml_with_places(file, _Content)
    given = _source(content, places)
    if "shape" in content.model_fields_set and given not in ("waypoints", "points"):
        raise InputError(
            f"shape is for waypoints and points only: `{given}` is flown as it is given",
            where=places.where_key("shape"),
            hint="leave shape out, or give waypoints or points",
        )
    path, waypoints, *losses = _SOURCES[given](content, places)
    path.check(where=places.where(given))

    if content.yaw.angle_deg and content.yaw.mode is not YawMode.FIXED:
        raise InputError(
            "angle_deg is for mode fixed only",
            where=places.where_key("yaw", "angle_deg"),
            hint="leave angle_deg out, or set mode: fixed",
        )
    place, turn = content.place, math.radians(content.place.yaw_deg)
    offset = np.array([place.x, place.y, place.z])
    fixed = content.yaw.mode is YawMode.FIXED
    angle = math.remainder(math.radians(content.yaw.angle_deg) + turn, math.tau) if fixed else 0.0
    return PathFile(
        name=content.name or file.stem,
        path=path.placed(offset, turn),
        yaw=content.yaw.mode,
        yaw_angle=angle,
        speed=content.speed,
        laps=content.laps,
        waypoints=waypoints @ rotation_about_z(turn).T + offset,
        source=file,
        losses=tuple(losses),
        shape=content.shape,
    )


def path_through(points: ArrayLike, name: str = "points") -> PathFile:
    """Return the path through waypoints, (K, 3) m, as a file with `points` gives it: at yaw 0, at full speed, one lap.

    Raises:
        InputError: no numbers, another shape, too few, too near to one another, too many, or too far away.
    """
    try:
        rows = np.array(points, dtype=float)
    except (TypeError, ValueError):
        raise InputError("points must be rows of three numbers", where=name, hint=_POINTS_HINT) from None
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise InputError(f"points must have the shape (K, 3), not {rows.shape}", where=name, hint=_POINTS_HINT)
    if len(rows) > _MAX_POINTS:
        raise InputError(f"more than {_MAX_POINTS} points", where=name, hint="give fewer points")
    check_points(rows, MIN_SPACING, lambda index: f"{name}, row {index + 1}")
    path = min_snap(rows)
    path.check(where=name)
    return PathFile(name, path, YawMode.FIXED, 0.0, 1.0, 1, rows, pathlib.Path(name))


def _source(content: _Content, places: Places) -> str:
    given = [key for key in _SOURCES if getattr(content, key) is not None]
    if not given:
        raise InputError(
            f"one of {', '.join(_SOURCES)} is needed",
            where=places.where(),
            hint="list waypoints: [[x, y, z], ...] in metres",
        )
    if len(given) > 1:
        later = max(given, key=lambda key: places.keys[(key,)])
        raise InputError(
            f"only one of {' and '.join(given)} may be given",
            where=places.where_key(later),
            hint="keep the one that describes the path",
        )
    return given[0]


def _from_waypoints(content: _Content, places: Places) -> tuple[Path, NDArray]:
    rows = content.waypoints or []
    for index, row in enumerate(rows):
        if len(row) != 3:
            raise InputError(
                f"waypoint {index + 1} has {len(row)} numbers, not x, y, z",
                where=places.where("waypoints", index),
                hint="write it as [x, y, z] in metres",
            )
    points = np.array(rows, dtype=float).reshape(-1, 3)
    if len(points) < 2:
        raise InputError(
            f"a path needs at least two waypoints, not {len(points)}",
            where=places.where("waypoints"),
            hint="add a waypoint: a path has a start and an end",
        )
    check_points(points, MIN_SPACING, lambda index: places.where("waypoints", index))
    points = _repeated(points, content.laps, places)
    return _path_with(min_snap, points, places.where("waypoints")), points


def _from_points(content: _Content, places: Places) -> tuple[Any, ...]:
    """Return path and waypoints, and a word if these are rather samples of a curve."""
    rows, left_out = _read_points(places, content.points, MIN_SPACING)
    points = _repeated(rows, content.laps, places)
    words = (f"{len(rows)} rows are waypoints here: write `curve: {content.points}` if they are samples of a curve",)
    path = _path_with(min_snap, points, str(_beside(places, content.points)))
    return path, points, *(words if len(rows) >= _MANY_WAYPOINTS else ()), *left_out


def _from_curve(content: _Content, places: Places) -> tuple[Any, ...]:
    points, left_out = _read_points(places, content.curve, MIN_DENSE_SPACING)
    if len(points) < _LEAST_SAMPLED:
        raise InputError(
            f"a curve needs at least {_LEAST_SAMPLED} samples, not {len(points)}",
            where=str(_beside(places, content.curve)),
            hint="add rows x, y, z to the file, or write `points:` if they are waypoints",
        )
    points = _repeated(points, content.laps, places)
    return _path_with(smooth_through, points, str(_beside(places, content.curve))), points, *left_out


def _read_points(places: Places, name: str | None, spacing: float) -> tuple[NDArray, tuple[str, ...]]:
    """Return two points or more, (K, 3) m, `spacing`, m, apart or more, from a file beside; and what it leaves out."""
    file = _beside(places, name)
    what = "x, y, z; write `samples:` for rows of t, x, y, z"
    points, lines, others = read_named_table(file, ("x", "y", "z"), what)
    if len(points) < 2:
        raise InputError(
            f"a path needs at least two points, not {len(points)}", where=str(file), hint="add rows x, y, z to the file"
        )
    many = spacing == MIN_SPACING and len(points) >= _MANY_WAYPOINTS
    hint = f"write `curve: {name}` if the rows are samples of a curve, or remove one of them" if many else REMOVE_HINT
    check_points(points, spacing, lambda index: f"{file}:{lines[index]}", hint)
    return points, _left_out(others)


def _left_out(columns: list[str]) -> tuple[str, ...]:
    return (f"columns are not used: {', '.join(columns)}",) if columns else ()


def _from_polynomials(content: _Content, places: Places) -> tuple[Any, ...]:
    return read_polynomials(_beside(places, content.polynomials), laps=content.laps)


def _from_samples(content: _Content, places: Places) -> tuple[Any, ...]:
    """Return path and points, and what is lost."""
    file = _beside(places, content.samples)
    what = "t, x, y, z; or name the columns so in the first line"
    rows, lines, others = read_named_table(file, ("t", "x", "y", "z"), what, more="yaw")
    rows[:, 0] -= rows[0, 0]
    motion = timed_samples(rows, lines, str(file))
    points = _repeated(motion.points(), content.laps, places)
    check_points(points, MIN_DENSE_SPACING, lambda _: str(file))
    if len(points) < _LEAST_SAMPLED:
        raise InputError(
            f"the motion is too short for a smooth path: it leaves {len(points)} points, not {_LEAST_SAMPLED}",
            where=str(file),
            hint="give a longer motion, or list waypoints",
        )
    path = _path_with(smooth_through, points, str(file))
    return path, points, *motion.losses(path), *_left_out(others)


_SOURCES: dict[str, Callable[[_Content, Places], tuple[Any, ...]]] = {
    "waypoints": _from_waypoints, "points": _from_points, "curve": _from_curve,
    "polynomials": _from_polynomials, "samples": _from_samples,
}  # fmt: skip


def _path_with(through: Callable[[NDArray], Path], points: NDArray, where: str) -> Path:
    """Return the path through points. Raises InputError that names `where` too if no smooth path joins them."""
    try:
        return through(points)
    except InputError as error:
        raise InputError(error.what, where=f"{where}, {error.where}", hint=error.hint) from None


def _beside(places: Places, name: str | None) -> pathlib.Path:
    return pathlib.Path(places.file).parent / (name or "")


def _repeated(points: NDArray, laps: int, places: Places) -> NDArray:
    """Return the points of all laps; the end of a lap is the start of the next and occurs once."""
    if 1 + laps * (len(points) - 1) > _MAX_POINTS:
        raise InputError(
            f"more than {_MAX_POINTS} points", where=places.where("laps"), hint="give fewer points or laps"
        )
    if laps == 1:
        return points
    gap = float(np.linalg.norm(points[-1] - points[0]))
    if gap >= MIN_SPACING:
        raise InputError(
            f"{laps} laps need a closed path, but the last point is {gap:.3f} m from the first",
            where=places.where("laps"),
            hint="end the path with its first point",
        )
    lap = np.concatenate([points[1:-1], points[:1]])
    return np.concatenate([points[:1], np.tile(lap, (laps, 1))])
