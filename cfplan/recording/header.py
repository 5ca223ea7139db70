"""The header of a record: flight, vehicle and limits; to JSON and back."""

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.files.json_values import json_value, replace_surrogates
from cfplan.flight.setpoints.encoding import LEAD, RATE
from cfplan.geometry.path_file import fingerprint
from cfplan.safety.limits import Limits, PlanLimits
from cfplan.safety.space import Box, Cylinder, Obstacle
from cfplan.vehicle.airframe import Airframe, airframe_of
from cfplan.version import __version__

if TYPE_CHECKING:
    from cfplan.planning.plan_result import Plan

Triple = tuple[float, float, float]

PROMISED_LATENESS = 2e-3  # s, of 99 % of the setpoints
FINGERPRINT, FLOWN = "path file's fingerprint", "flown"  # keys of the provenance
_PATH_SAMPLES = 500  # of the drawn path
_NO_SHIFT = np.empty((0, 3))


@dataclass(frozen=True, slots=True)
class FlightBounds:
    """Limits by which a flight is judged, drawn as lines in the plots; NaN if there is none."""

    speed: float = math.nan  # m/s
    acceleration: float = math.nan  # m/s², gravity not counted
    body_rate: float = math.nan  # rad/s, norm
    deviation: float = math.nan  # m, from the reference in time
    lateness: float = math.nan  # s, of a setpoint
    pose_age: float = math.nan  # s
    battery_voltage: float = math.nan  # V, least


_NO_BOUNDS = FlightBounds()


@dataclass(frozen=True, slots=True)
class RecordHeader:
    """Data known before take-off, enough to draw and judge the flight without any other file."""

    name: str
    version: str  # of cfplan
    uri: str
    planner: str
    vehicle: Airframe
    thrust_at_full_command: float  # N, one motor's thrust at the 16-bit command 65535
    plan_limits: PlanLimits
    bounds: FlightBounds
    travel_time: float  # s, planned
    path: NDArray  # (M, 3) m, samples for drawing and for the distance to the path
    fence: tuple[Triple, Triple]  # m, lower and upper corner
    wall_time_at_zero: float  # s since 1970, when the flight's clock was at zero
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Origin of the plan: file, model hash, …"""
    obstacles: tuple[Obstacle, ...] = ()
    shift: NDArray = field(default_factory=_NO_SHIFT.copy)
    """(N, 3) m, correction of setpoints 0 … of the plan by earlier flights; empty if there is none."""


def header_under(
    limits: Limits,
    *,
    name: str,
    uri: str,
    path: NDArray,
    travel_time: float,
    planner: str = "",
    bounds: FlightBounds = _NO_BOUNDS,
    wall_time_at_zero: float = 0.0,
    provenance: Mapping[str, str] | None = None,
) -> RecordHeader:
    """Return the header of a flight under these limits, written by this version."""
    return RecordHeader(
        name=name,
        version=__version__,
        uri=uri,
        planner=planner,
        vehicle=limits.airframe,
        thrust_at_full_command=limits.airframe.motor_thrust_max * limits.airframe.thrust_scale,
        plan_limits=limits.plan,
        bounds=bounds,
        travel_time=travel_time,
        path=path,
        fence=(limits.space.low, limits.space.high),
        wall_time_at_zero=wall_time_at_zero,
        provenance=provenance or {},
        obstacles=limits.space.obstacles,
    )


def header_of_steering(
    limits: Limits, *, name: str, uri: str, place: Triple, yaw: float, wall_time_at_zero: float
) -> RecordHeader:
    """Return the header of a flight without a path yet, which begins in hover at a position, m, and yaw, rad.

    Both are stored exactly, as `cfplan check` simulates the flight again from there.
    """
    return header_under(
        limits,
        name=name,
        uri=uri,
        planner="in flight",
        bounds=_bounds(limits),
        travel_time=0.0,
        path=np.array([place], dtype=float),
        wall_time_at_zero=wall_time_at_zero,
        provenance={"yaw": repr(float(yaw))},
    )


def _bounds(limits: Limits) -> FlightBounds:
    return FlightBounds(
        speed=limits.flight.speed.brake,
        acceleration=limits.flight.acceleration.brake,
        body_rate=limits.flight.angular_velocity.brake,
        deviation=limits.flight.deviation.brake,
        lateness=PROMISED_LATENESS,
        pose_age=limits.pose.age_warning,
        battery_voltage=limits.battery.under_load,
    )


def header_of_plan(
    plan: "Plan", *, name: str, uri: str, source: FilePath, wall_time_at_zero: float, uncorrected: "Plan | None" = None
) -> RecordHeader:
    """Return the header of the flight of a plan that was made from a path file, or read from a plan file.

    `uncorrected` is the plan before its correction, if there is one. Raises InputError if the path file cannot be read.
    """
    limits, wanted = plan.limits, uncorrected or plan
    header = header_under(
        limits,
        name=name,
        uri=uri,
        planner=plan.planner,
        bounds=_bounds(limits),
        travel_time=plan.trajectory.duration,
        path=wanted.path(np.linspace(0.0, wanted.path.end, _PATH_SAMPLES)),
        wall_time_at_zero=wall_time_at_zero,
        provenance={"path file": str(source), "planner": plan.planner} | _fingerprint(source),
    )
    if uncorrected is None:
        return header
    times = np.arange(int(np.ceil(plan.trajectory.duration * RATE)) + 2) / RATE + LEAD
    s = plan.trajectory.s_at(times)
    return replace(header, shift=np.round(plan.path(s) - uncorrected.path(s), 6))


def _fingerprint(source: FilePath) -> dict[str, str]:
    """Return the fingerprint of a path file; nothing for a plan file, or without a file."""
    return {} if source.suffix == ".parquet" or not source.is_file() else {FINGERPRINT: fingerprint(source)}


def header_to_json(header: RecordHeader) -> str:
    """Return the header as one line of JSON; numbers that are not finite become null."""
    return json.dumps(json_value(header), allow_nan=False)


def header_from_json(text: str, *, where: str = "") -> RecordHeader:
    """Read a header. Raises InputError if a key is missing or of the wrong kind.

    Records outlive versions: unknown keys are ignored, missing limits are NaN.
    """
    try:
        values = replace_surrogates(json.loads(text))
        return RecordHeader(
            name=str(values["name"]),
            version=str(values["version"]),
            uri=str(values["uri"]),
            planner=str(values["planner"]),
            vehicle=airframe_of(values["vehicle"]),
            thrust_at_full_command=_number(values["thrust_at_full_command"]),
            plan_limits=PlanLimits(
                **{f.name: _limit(values["plan_limits"].get(f.name), f) for f in fields(PlanLimits)}
            ),
            bounds=FlightBounds(**{f.name: _number(values["bounds"].get(f.name)) for f in fields(FlightBounds)}),
            travel_time=_number(values["travel_time"]),
            path=np.array(values["path"], dtype=float).reshape(-1, 3),
            fence=(_triple(values["fence"][0]), _triple(values["fence"][1])),
            wall_time_at_zero=_number(values["wall_time_at_zero"]),
            provenance={str(key): str(value) for key, value in values["provenance"].items()},
            obstacles=tuple(map(_obstacle, values.get("obstacles", ()))),
            shift=np.array(values.get("shift", ()), dtype=float).reshape(-1, 3),
        )
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError) as error:
        raise InputError(
            f"the record's header cannot be read ({type(error).__name__}: {error})".replace("\n", " "),
            where=where,
            hint="it was written by another version of cfplan, or is damaged",
        ) from error


def _obstacle(values: Mapping[str, Any]) -> Obstacle:
    name = str(values["name"])
    if "radius" in values:
        x, y, radius, low, high = (_number(values[key]) for key in ("x", "y", "radius", "low", "high"))
        return Cylinder(x, y, radius, low, high, name)
    return Box(_triple(values["low"]), _triple(values["high"]), _number(values["yaw"]), name)


def _limit(value: float | None, limit: Field) -> float:
    """Read a limit: null, as JSON has no infinity, is the default of a limit that has one, and NaN for the others."""
    return _number(value) if value is not None or limit.default is MISSING else limit.default


def _triple(values: list[float | None]) -> Triple:
    x, y, z = (_number(value) for value in values)
    return x, y, z


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
