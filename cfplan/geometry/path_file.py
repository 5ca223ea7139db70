"""Path files, path.yaml: which curve to fly, where in the room, with which yaw.

name: figure eight
waypoints: [[0, 0, 1], [1, 1, 1], …]    # see below; or  points: file.csv  (waypoints, x, y, z a row)
                                        # or  curve: file.csv  (samples of a curve, x, y, z a row)
                                        # or  polynomials: file.csv  (as Crazyswarm writes them)
                                        # or  samples: file.csv  (t, x, y, z a row; their timing is not kept)
shape: fastest                          # of waypoints: the path is chosen when planning; or min-snap
times: centripetal                      # of the segments of shape min-snap; or length
corridor: 0.3                           # m that the fastest path may lead away from the straight lines, if given
yaw: {mode: fixed, angle_deg: 30}       # or  yaw: tangent,  yaw: free;  fixed at 0 if left out
laps: 3                                 # of a closed path, flown through without a stop
speed: 0.5                              # speed factor: 1 is as fast as the limits allow
place: {x: 0, y: 0, z: 0, yaw_deg: 90}  # turned about z through the origin, then moved; a fixed yaw turns too

The fastest path may pass a waypoint within a distance, m, or through a gate, in the direction of its yaw:

waypoints:
  - [0, 0, 1]
  - {at: [1, 0, 1], within: 0.1}
  - {gate: [2, 1, 1], yaw_deg: 90, width: 0.6, height: 0.6}
"""

import hashlib
import math
import pathlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from cfplan.errors import InputError
from cfplan.files.text import read_named_table, read_text
from cfplan.files.yaml_with_places import HINT, Places, read_yaml_with_places
from cfplan.geometry.min_snap import (
    MIN_DENSE_SPACING,
    MIN_SPACING,
    REMOVE_HINT,
    centripetal_times,
    check_points,
    min_snap,
    smooth_through,
)
from cfplan.geometry.path import Path, rotation_about_z
from cfplan.geometry.polynomial_csv import read_polynomials
from cfplan.geometry.timed_samples import timed_samples
from cfplan.geometry.waypoints import Gate, Region, Within
from cfplan.geometry.yaw import YawMode

_LEAST_SAMPLED = 4  # points that a smooth path with free ends needs
_MANY_WAYPOINTS = 50  # rows of `points`; more are probably samples of a curve
_MAX_POINTS = 50_000  # over all laps
MOST_WITHIN = 100.0  # m, of a region, a gate or a corridor
_POINTS_HINT = "give x, y, z in metres, as [[0, 0, 1], [1, 0, 1]]"


class PathShape(StrEnum):
    """The kind of curve through waypoints."""

    FASTEST = "fastest"  # the shortest flight time, see planning/path/choice.py
    MIN_SNAP = "min-snap"  # minimum snap for given segment times


class SegmentTimes(StrEnum):
    """Times of the segments of a path of least snap."""

    CENTRIPETAL = "centripetal"  # in proportion to the roots of straight lengths
    LENGTH = "length"  # in proportion to straight lengths


@dataclass(frozen=True, slots=True)
class PathFile:
    """A path file's content, checked and placed in the room."""

    name: str
    path: Path  # in the frame of the room; of least snap until planning chooses another
    yaw: YawMode
    yaw_angle: float  # rad, in the frame of the room, in mode fixed; otherwise 0
    speed: float  # speed factor in (0, 1]; 1 is not slowed
    laps: int
    waypoints: NDArray  # (K, 3) m, in the frame of the room, all laps
    source: pathlib.Path
    losses: tuple[str, ...] = ()  # what was lost from the source, a few words each
    shape: PathShape | None = None  # of the path through waypoints; None for a given curve
    regions: tuple[Region, ...] = ()  # where each waypoint may be passed, all laps; empty for a given curve
    corridor: float | None = None  # m, how far the path may lead from the straight lines between waypoints

    def placed(self, offset: ArrayLike, turn: float) -> "PathFile":
        """Return the same turned by `turn`, rad, about z through the origin, then moved by `offset`, (3,) m."""
        fixed = self.yaw is YawMode.FIXED
        return replace(
            self,
            path=self.path.placed(np.asarray(offset, dtype=float), turn),
            yaw_angle=math.remainder(self.yaw_angle + turn, math.tau) if fixed else 0.0,
            waypoints=self.waypoints @ rotation_about_z(turn).T + offset,
            regions=tuple(region and region.turned(turn) for region in self.regions),
        )


class _Yaw(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    mode: YawMode
    angle_deg: float = Field(default=0.0, ge=-360.0, le=360.0)


class PathPlace(BaseModel):
    """Where in the room a path lies: it is turned about z through the origin, then moved."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw_deg: float = Field(default=0.0, ge=-360.0, le=360.0)

    @property
    def motion(self) -> tuple[tuple[float, float, float], float]:
        """Return the offset, m, and the turn, rad."""
        return (self.x, self.y, self.z), math.radians(self.yaw_deg)


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


class _Waypoint(BaseModel):
    """A waypoint of a file: a list of numbers, or keys with values."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    at: list[float] | None = None
    within: float | None = Field(default=None, gt=0.0, le=MOST_WITHIN)
    gate: list[float] | None = None
    yaw_deg: float | None = Field(default=None, ge=-360.0, le=360.0)
    width: float | None = Field(default=None, gt=0.0, le=MOST_WITHIN)
    height: float | None = Field(default=None, gt=0.0, le=MOST_WITHIN)

    @model_validator(mode="before")
    @classmethod
    def _from_list(cls, value: Any) -> Any:
        return {"at": value} if isinstance(value, list) else value

    @model_validator(mode="after")
    def _whole(self) -> Self:
        of_gate = [key for key in ("yaw_deg", "width", "height") if getattr(self, key) is not None]
        if self.gate is None and of_gate:
            raise ValueError(f"{of_gate[0]} is of a gate{HINT}write `gate: [x, y, z]` instead of `at`")
        if (self.at is None) == (self.gate is None):
            raise ValueError(f"a waypoint is either `at` or a `gate`{HINT}write [x, y, z], or {{gate: [x, y, z], …}}")
        if self.gate is not None and (self.within is not None or len(of_gate) < 3):
            raise ValueError(f"a gate has yaw_deg, width and height, and nothing else{HINT}give all three")
        return self

    @property
    def position(self) -> list[float]:
        return (self.gate if self.at is None else self.at) or []

    @property
    def region(self) -> Region:
        if self.gate is not None:
            return Gate(math.radians(self.yaw_deg or 0.0), self.width or 0.0, self.height or 0.0)
        return None if self.within is None else Within(self.within)


class _Content(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(default="", max_length=100, pattern=r"^[^\n\r]*$")
    waypoints: list[_Waypoint] | None = None
    points: str | None = None
    curve: str | None = None
    polynomials: str | None = None
    samples: str | None = None
    shape: PathShape = PathShape.FASTEST
    times: SegmentTimes = SegmentTimes.CENTRIPETAL
    corridor: float | None = Field(default=None, gt=0.0, le=MOST_WITHIN)
    yaw: Annotated[_Yaw, BeforeValidator(_short_yaw)] = _Yaw(mode=YawMode.FIXED)
    laps: int = Field(default=1, ge=1, le=1000)
    speed: Annotated[float, Field(gt=0.0, le=1.0), BeforeValidator(_share)] = 1.0
    place: PathPlace = PathPlace()


def fingerprint(file: pathlib.Path) -> str:
    """Return the SHA-256 of a path file's text and of its waypoints, which may be in another file.

    Raises InputError as load_path_file() does.
    """
    waypoints = np.round(load_path_file(file).waypoints, 6) + 0.0  # no negative zeros
    return hashlib.sha256(read_text(file).encode() + waypoints.tobytes()).hexdigest()


def load_path_file(file: pathlib.Path | str) -> PathFile:
    """Read a path.yaml, and check that its path can be flown without a stop.

    Raises:
        InputError: a mistake in it or in the file that it names; with line and column.
    """
    file = pathlib.Path(file)
    content, places = read_yaml_with_places(file, _Content, lambda data: _of_one_vehicle(data, file))
    given = _source(content, places)
    through = given in ("waypoints", "points")
    _check_choice(content, places, given, through)
    path, waypoints, *losses = _SOURCES[given](content, places)
    if not through:  # between waypoints a path may turn back: it stops there for no longer than a moment
        path.check(where=places.where(given))

    if content.yaw.angle_deg and content.yaw.mode is not YawMode.FIXED:
        raise InputError(
            "angle_deg is for mode fixed only",
            where=places.where_key("yaw", "angle_deg"),
            hint="leave angle_deg out, or set mode: fixed",
        )
    return PathFile(
        name=content.name or file.stem,
        path=path,
        yaw=content.yaw.mode,
        yaw_angle=math.radians(content.yaw.angle_deg),
        speed=content.speed,
        laps=content.laps,
        waypoints=waypoints,
        source=file,
        losses=tuple(losses),
        shape=content.shape if through else None,
        regions=_regions(content, len(waypoints), places) if through else (),
        corridor=content.corridor,
    ).placed(*content.place.motion)


def _of_one_vehicle(data: dict[str, Any], file: pathlib.Path) -> dict[str, Any]:
    """Return the data, or raise InputError for a fleet file."""
    if "vehicles" in data:
        raise InputError(
            "a fleet file, where the path of one vehicle is needed",
            where=str(file),
            hint="`cfplan plan`, `check` and `sim` take fleets; the others take the path file of one vehicle",
        )
    return data


def _check_choice(content: _Content, places: Places, given: str, through: bool) -> None:
    """Raise InputError for keys that do not apply to the file's source or shape."""
    for key in ("shape", "times", "corridor"):
        if key in content.model_fields_set and not through:
            raise InputError(
                f"{key} is for waypoints and points only: `{given}` already defines its shape",
                where=places.where_key(key),
                hint=f"leave {key} out, or give waypoints or points",
            )
    fastest = content.shape is PathShape.FASTEST
    if "times" in content.model_fields_set and fastest:
        raise InputError(
            "times are for shape: min-snap only: those of the fastest path are chosen",
            where=places.where_key("times"),
            hint="leave times out, or write `shape: min-snap`",
        )
    if fastest:
        return
    if content.corridor is not None:
        raise InputError(
            "a corridor is for shape: fastest only",
            where=places.where_key("corridor"),
            hint="leave shape or corridor out",
        )
    for index, waypoint in enumerate(content.waypoints or []):
        if waypoint.region is not None:
            raise InputError(
                "gates and `within` are for shape: fastest only",
                where=places.where("waypoints", index),
                hint="leave shape out, or write the waypoint as [x, y, z]",
            )


def _regions(content: _Content, count: int, places: Places) -> tuple[Region, ...]:
    """Return the region of each waypoint of all laps, `count`, before the path is placed. Raises InputError."""
    if content.waypoints is None:
        return (None,) * count
    of_file = [waypoint.region for waypoint in content.waypoints]
    if content.laps == 1:
        return tuple(of_file)
    if of_file[-1] != of_file[0]:
        raise InputError(
            "the last waypoint is the first one of the next lap, and differs from it in its gate or `within`",
            where=places.where("waypoints", len(of_file) - 1),
            hint="write both alike, or fly one lap",
        )
    return (*of_file[:1], *of_file[1:] * content.laps)


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
    path = min_snap(rows, times=_nominal(rows))
    return PathFile(
        name, path, YawMode.FIXED, 0.0, 1.0, 1, rows, pathlib.Path(name), (), PathShape.FASTEST, (None,) * len(rows)
    )


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
    rows = [waypoint.position for waypoint in content.waypoints or []]
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
    return _path_with(_least_snap(content), points, places.where("waypoints")), points


def _from_points(content: _Content, places: Places) -> tuple[Any, ...]:
    """Return path and waypoints, and a note if these are probably samples of a curve."""
    rows, left_out = _read_points(places, content.points, MIN_SPACING)
    points = _repeated(rows, content.laps, places)
    words = (f"{len(rows)} rows are waypoints here: write `curve: {content.points}` if they are samples of a curve",)
    path = _path_with(_least_snap(content), points, str(_beside(places, content.points)))
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


def _least_snap(content: _Content) -> Callable[[NDArray], Path]:
    """Return the function that lays a path of least snap through points, with the file's segment times."""
    if content.times is SegmentTimes.LENGTH:
        return min_snap
    return lambda points: min_snap(points, times=_nominal(points))


def _nominal(points: NDArray) -> NDArray:
    """Return centripetal times, (K-1,) s, for a mean speed of 1 m/s between points, (K, 3) m."""
    times = centripetal_times(points)
    return times * (np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / times.sum())


def _read_points(places: Places, name: str | None, spacing: float) -> tuple[NDArray, tuple[str, ...]]:
    """Return two points or more, (K, 3) m, `spacing`, m, apart or more, from a file; and what it leaves out."""
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
    """Return the path through points. Raises InputError, with `where`, if no smooth path joins them."""
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
