"""safety.yaml, read strictly: every error has its line and column."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Len, Lt
from pydantic import StringConstraints

from cfplan.errors import CfplanError, InputError
from cfplan.files.schema import Keys, read_as, schema_of
from cfplan.files.yaml_with_places import Places, read_plain, read_yaml_with_places
from cfplan.safety.feasibility import describe_hover, hover_violation
from cfplan.safety.limits import (
    LARGEST_IN_PACKET,
    SHORTEST_MANOEUVRE,
    Encodable,
    FirmwareSettings,
    FlightLimits,
    Ladder,
    Limits,
    LinkLossLimits,
    PlanLimits,
    Positive,
    within_reserve,
)
from cfplan.safety.quantities import ON_LADDER
from cfplan.safety.space import SIDES, Box, Cylinder, Space, inside
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.airframes import load_airframe

DEFAULTS = Path(__file__).with_name("defaults.yaml")  # a complete safety.yaml, with comments

_PLANNING_MINIMA = {
    "speed": 0.02,
    "acceleration": 0.05,
    "angular_velocity": 0.05,
    "angular_acceleration": 0.05,
}
"""Lower bounds of planning limits: slower motion would be hidden by noise of gyroscope and poses."""

_PEAK_OVER_MEAN = {"take_off_speed": 15 / 8, "go_to_speed": 15 / 8, "land_speed": 1.5}
"""Ratio of largest to mean speed, for the mean speeds under `ground`: motions between two hovers, and landing."""
_PEAK_ACCELERATION = 10 / math.sqrt(3)  # m/s², of a motion between two hovers over 1 m in 1 s

_LOOKED_AT = 65  # grid points along each side of the room, for places to take off to

_QUARTER_TURN = math.pi / 2  # a tilt limit below this many degrees is taken for radians

Coordinate = Annotated[float, Ge(-LARGEST_IN_PACKET), Le(LARGEST_IN_PACKET)]
Corner = tuple[Coordinate, Coordinate, Coordinate]


class _Box(Keys):
    low: Corner
    high: Corner
    yaw_deg: Annotated[float, Ge(-360.0), Le(360.0)] = 0.0


class _Cylinder(Keys):
    x: Coordinate
    y: Coordinate
    radius: Encodable
    height: Encodable


class _Obstacle(Keys):
    name: Annotated[str, Len(1, 40)] = ""
    box: _Box | None = None
    cylinder: _Cylinder | None = None


class _Space(Keys):
    low: Corner
    high: Corner
    margin: Positive
    obstacles: Annotated[tuple[_Obstacle, ...], Len(0, 1000)]


_Version = Annotated[str, StringConstraints(pattern=r"^\d{4}\.\d{1,2}(\.\d{1,3})?$")]

_SafetyFile: Any = schema_of(
    Limits,
    airframe=None,  # it has a file of its own
    vehicle=Annotated[str, Len(1, 200)],
    plan=schema_of(
        PlanLimits, speed=Encodable, acceleration=Encodable, angular_velocity=Encodable,
        angular_acceleration=Positive, motor_thrust_min=None, motor_thrust_max=None,
        specific_thrust_min=None, motor_reserve=Annotated[float, Gt(0.0), Lt(0.5)], specific_thrust=Positive,
    ),
    space=_Space,
    firmware=schema_of(FirmwareSettings, oldest=_Version, newest=_Version),
    link_loss=schema_of(LinkLossLimits, only_warn=None, outside=Literal["refuse", "warn"]),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Key:
    """A key of safety.yaml."""

    name: str  # with its section, as plan.speed
    default: Any  # None if the key is required
    range: str  # allowed values, in words


def all_keys() -> tuple[Key, ...]:
    """Return every key that safety.yaml may have, in the order of the file; a ladder with its three rungs is one."""
    schema = _SafetyFile.model_json_schema()
    definitions, defaults, found = schema["$defs"], _defaults(), []
    in_file = read_plain(DEFAULTS)
    for name in sorted(schema["properties"], key=list(in_file).index):
        kind = schema["properties"][name]
        section = definitions.get(kind.get("$ref", "").split("/")[-1])
        if section is None:
            found.append(Key(name, defaults.get(name), _range(kind)))
            continue
        for key in sorted(section["properties"], key=list(in_file[name]).index):
            value = section["properties"][key]
            rungs = definitions.get(value.get("$ref", "").split("/")[-1], {}).get("properties")
            words = f"each {_range(rungs['brake'])}" if rungs else _range(value)
            found.append(Key(f"{name}.{key}", defaults.get(name, {}).get(key), words))
    return tuple(found)


def _range(kind: dict[str, Any]) -> str:
    """Return the allowed values of a JSON Schema, in words: "above 0, at most 2"."""
    if "enum" in kind:
        return " or ".join(kind["enum"])
    if kind["type"] == "boolean":
        return "true or false"
    if kind["type"] == "string":
        return "text"
    if kind["type"] == "array":
        least, most = kind.get("minItems", 0), kind["maxItems"]
        if "$ref" in kind.get("items", {}):
            return f"{least} to {most} entries"
        each = _range(kind["items"] if "items" in kind else kind["prefixItems"][0])
        return f"{least} to {most}, each {each}" if least < most else f"{most} numbers, each {each}"
    if "minimum" in kind:
        return f"from {kind['minimum']:g} to {kind['maximum']:g}"
    side = f"at most {kind['maximum']:g}" if "maximum" in kind else f"below {kind['exclusiveMaximum']:g}"
    return f"above {kind['exclusiveMinimum']:g}, {side}"


@lru_cache(maxsize=1)
def _defaults() -> dict[str, Any]:
    """Return the defaults of all keys except vehicle and room, which only the lab knows."""
    defaults = read_plain(DEFAULTS)
    del defaults["vehicle"], defaults["space"]["low"], defaults["space"]["high"]
    return defaults


def _complete(content: dict[str, Any]) -> dict[str, Any]:
    """Return the content with defaults for missing keys, also in sections."""
    added = _filled(content, _defaults())
    if "space" not in content:
        del added["space"]
    return added


def _filled(content: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    filled = {**defaults, **content}
    for key, value in content.items():
        if isinstance(value, dict) and isinstance(defaults.get(key), dict):
            filled[key] = _filled(value, defaults[key])
    return filled


def load_limits(file: Path | str) -> Limits:
    """Read safety.yaml, strictly validated, and find its vehicle. Missing keys have their default.

    Raises:
        InputError: unknown keys, limits that are not positive, that contradict each other, that make hovering
            impossible or that exceed the vehicle's abilities; with `file:line:column`.
    """
    content, places = read_yaml_with_places(file, _SafetyFile, _complete)
    _check_order(content, places)
    airframe = _vehicle(content.vehicle, Path(file).parent, places)
    limits = read_as(
        Limits,
        content,
        airframe=airframe,
        plan=read_as(
            PlanLimits,
            content.plan,
            specific_thrust_min=content.plan.specific_thrust,
            **within_reserve(airframe, content.plan.motor_reserve),
        ),
        space=_space(content.space),
        firmware=read_as(
            FirmwareSettings,
            content.firmware,
            oldest=_version(content.firmware.oldest),
            newest=_version(content.firmware.newest),
        ),
        link_loss=read_as(LinkLossLimits, content.link_loss, only_warn=content.link_loss.outside == "warn"),
    )
    _check_obstacles(limits, places)
    _check_vehicle_can(limits, places)
    return limits


def _vehicle(name: str, folder: Path, places: Places) -> Airframe:
    try:
        return load_airframe(folder / name if name.endswith((".yaml", ".yml")) else name)
    except CfplanError as error:
        if error.where:
            raise
        raise InputError(error.what, where=places.where("vehicle"), hint=error.hint) from None


def _space(section: _Space) -> Space:
    obstacles: list[Box | Cylinder] = []
    for each in section.obstacles:
        if box := each.box:
            obstacles.append(Box(box.low, box.high, math.radians(box.yaw_deg), each.name))
        if round_ := each.cylinder:
            foot = section.low[2]
            obstacles.append(Cylinder(round_.x, round_.y, round_.radius, foot, foot + round_.height, each.name))
    return Space(section.low, section.high, section.margin, tuple(obstacles))


def _version(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(".")))


def _check_order(content: Any, places: Places) -> None:
    """Check the order of values within the file."""
    _check_limits(content, places)
    _check_space(content, places)
    _check_vehicle(content, places)


def _check_limits(content: Any, places: Places) -> None:
    for section, key in (("plan", "tilt_deg"), ("flight", "stop_tilt_deg")):
        if (tilt := getattr(getattr(content, section), key)) < _QUARTER_TURN:
            raise InputError(
                f"{section}.{key} is {tilt:g}°: that hardly moves at all, and looks like radians",
                where=places.where(section, key),
                hint=f"write degrees: {tilt:g} rad is {math.degrees(tilt):.3g}; to fly slower, use --speed",
            )
    for key, least in _PLANNING_MINIMA.items():
        if getattr(content.plan, key) < least:
            raise InputError(
                f"plan.{key} is {getattr(content.plan, key):g}, less than {least:g}: noise would hide motion that slow",
                where=places.where("plan", key),
                hint=f"allow at least {least:g}; to fly slower, use --speed",
            )
    for name in (field.name for field in fields(FlightLimits) if field.type is Ladder):
        ladder = getattr(content.flight, name)
        if not ladder.brake < ladder.land < ladder.cut:
            raise InputError(
                f"flight.{name} must rise from brake over land to cut",
                where=places.where("flight", name, "brake"),
                hint="the pilot brakes first, then lands, then cuts the motors: write each larger than the one before",
            )
    for quantity in ON_LADDER:
        planned, abort = getattr(content.plan, quantity.key), getattr(content.flight, quantity.ladder).brake
        if planned >= abort:
            raise InputError(
                f"plan.{quantity.key} ({planned:g}) is not below flight.{quantity.ladder}.brake ({abort:g})",
                where=places.where("plan", quantity.key),
                hint=f"a flight as planned would be broken off: plan slower, or allow more in flight.{quantity.ladder}",
            )
    for key, peak in _PEAK_OVER_MEAN.items():
        most = content.plan.speed / peak
        if key != "land_speed":  # the largest acceleration is that of a motion that takes just SHORTEST_MANOEUVRE
            at_tilt = GRAVITY * math.tan(math.radians(content.plan.tilt_deg))
            most = min(most, min(content.plan.acceleration, at_tilt) * SHORTEST_MANOEUVRE / _PEAK_ACCELERATION)
        if getattr(content.ground, key) > most:
            raise InputError(
                f"ground.{key} is a mean speed, and a motion at a mean of {getattr(content.ground, key):g} m/s exceeds "
                "the limits under plan",
                where=places.where("ground", key),
                hint=f"write at most {math.floor(1000 * most) / 1000:g}",
            )


def _check_space(content: Any, places: Places) -> None:
    for axis, (low, high) in enumerate(zip(content.space.low, content.space.high, strict=True)):
        if not high - low > 2 * content.space.margin:
            raise InputError(
                f"the space from {low:g} to {high:g} m leaves no room within a margin of {content.space.margin:g} m",
                where=places.where("space", "high", axis),
                hint="lower the margin, or name a larger space, from its low corner to its high one",
            )
    for number, obstacle in enumerate(content.space.obstacles):
        _check_obstacle(obstacle, partial(places.where, "space", "obstacles", number))
    height = content.ground.take_off_height
    low, high, margin = content.space.low[2], content.space.high[2], content.space.margin
    if not inside(max(low + margin - height, height - (high - margin))):
        raise InputError(
            f"a take-off to {height:g} m ends outside the space or within its margin",
            where=places.where("ground", "take_off_height"),
            hint=f"write a height from {low + margin:g} to {high - margin:g} m",
        )


def _check_vehicle(content: Any, places: Places) -> None:
    if not content.battery.under_load < content.battery.at_rest:
        raise InputError(
            "battery.under_load must be below battery.at_rest",
            where=places.where("battery", "under_load"),
            hint="a battery's voltage falls under load; 3.2 V is usual",
        )
    pose = content.pose
    if not pose.age_warning < pose.age_brake < pose.age_land:
        raise InputError(
            "pose ages must rise from warning over brake to land",
            where=places.where("pose", "age_brake"),
            hint="write age_warning below age_brake, and age_brake below age_land",
        )
    if not pose.rate_min <= pose.rate:
        raise InputError(
            "pose.rate_min is above pose.rate",
            where=places.where("pose", "rate_min"),
            hint="rate is what motion capture should deliver, rate_min the least that it may",
        )
    if not 1.0 / pose.rate < pose.age_warning:
        raise InputError(
            f"at {pose.rate:g} Hz every pose grows older than pose.age_warning",
            where=places.where("pose", "age_warning"),
            hint=f"write an age_warning above {1.0 / pose.rate:.3g} s, or a higher rate",
        )
    if _version(content.firmware.newest) < _version(content.firmware.oldest):
        raise InputError(
            f"firmware.newest ({content.firmware.newest}) is older than firmware.oldest ({content.firmware.oldest})",
            where=places.where("firmware", "newest"),
            hint='write the newest that may fly, as "2026.08", or leave it out',
        )


def _check_obstacle(obstacle: _Obstacle, where: Callable[..., str]) -> None:
    if (obstacle.box is None) == (obstacle.cylinder is None):
        raise InputError(
            "an obstacle is either a box or a cylinder",
            where=where(),
            hint="write `box: {low: [x, y, z], high: [x, y, z]}` or `cylinder: {x: 0, y: 1, radius: 0.1, height: 2}`",
        )
    if obstacle.box is None:
        return
    for axis, (low, high) in enumerate(zip(obstacle.box.low, obstacle.box.high, strict=True)):
        if not low < high:
            raise InputError(
                f"the box from {low:g} to {high:g} m in {'xyz'[axis]} has no inside",
                where=where("box", "high", axis),
                hint="give its low corner and its high one; each coordinate of `low` is the smaller",
            )


def _check_obstacles(limits: Limits, places: Places) -> None:
    """Refuse obstacles that are not in the room, and those that leave no place to hover after take-off."""
    space = limits.space
    if not space.obstacles:
        return
    middle, half = np.add(space.low, space.high) / 2, np.subtract(space.high, space.low) / 2
    reach = space.beyond(middle, half)[SIDES:] - space.margin  # the room as a box: positive if it meets an obstacle
    if not (reach > 0.0).all():
        number = int(np.argmin(reach))
        raise InputError(
            f"{space.faces[SIDES + number]} is not in the room",
            where=places.where("space", "obstacles", number),
            hint="give its place in metres, in the frame of motion capture; leave it out where it is in another room",
        )
    room = replace(space, obstacles=())
    x, y = (np.linspace(low, high, _LOOKED_AT) for low, high in zip(space.low[:2], space.high[:2], strict=True))
    floor = np.stack(np.broadcast_arrays(x[:, None], y, limits.ground.take_off_height), axis=-1)
    for row in floor:
        clear = row[inside(room.beyond(row)).all(axis=1)]
        if inside(space.beyond(clear)).all(axis=1).any():
            return
    raise InputError(
        f"the obstacles, each with the margin of {space.margin:g} m about it, leave no place to take off to",
        where=places.where("space", "obstacles"),
        hint="give only what stands in the room, or lower the margin; or choose a smaller `space` around the free part",
    )


def _check_vehicle_can(limits: Limits, places: Places) -> None:
    """Refuse limits that exclude hovering, and limits that exceed the vehicle's abilities."""
    airframe, plan = limits.airframe, limits.plan
    if violated := hover_violation(airframe, plan):
        raise InputError(
            f"{airframe.name} cannot hover: {describe_hover(violated, airframe, plan)}",
            where=places.where("plan", violated.key),
            hint=violated.remedy,
        )
    strongest = 4 * plan.motor_thrust_max / airframe.mass
    steepest = math.acos(GRAVITY / strongest)
    if plan.tilt > steepest:
        raise InputError(
            f"{airframe.name} cannot hold its height beyond a tilt of {math.degrees(steepest):.1f}°",
            where=places.where("plan", "tilt_deg"),
            hint="allow no more than the vehicle can do",
        )
    if plan.tilt > limits.flight.stop_tilt:
        planned, stops = math.degrees(plan.tilt), math.degrees(limits.flight.stop_tilt)
        raise InputError(
            f"plan.tilt_deg ({planned:g}°) is above flight.stop_tilt_deg ({stops:g}°), which stops must keep",
            where=places.where("plan", "tilt_deg"),
            hint=f"plan at most {stops:g}°; the firmware's Mellinger controller fails beyond some 40°",
        )
    level = math.sqrt(strongest**2 - GRAVITY**2)
    if plan.acceleration > level:
        raise InputError(
            f"{airframe.name} cannot accelerate at more than {level:.1f} m/s² and hold its height",
            where=places.where("plan", "acceleration"),
            hint="allow no more than the vehicle can do",
        )
    against_drag = airframe.mass * level / airframe.drag[0] if airframe.drag[0] else math.inf
    if plan.speed > against_drag:
        raise InputError(
            f"{airframe.name} cannot fly faster than {against_drag:.1f} m/s and hold its height",
            where=places.where("plan", "speed"),
            hint="allow no more than the vehicle can do",
        )
    quickest = _quickest_turn(airframe)
    if plan.angular_acceleration > quickest:
        raise InputError(
            f"{airframe.name} cannot turn faster by more than {quickest:.0f} rad/s²",
            where=places.where("plan", "angular_acceleration"),
            hint="allow no more than the vehicle can do; motors follow far slower still",
        )


def _quickest_turn(airframe: Airframe) -> float:
    """Return the largest angular acceleration, rad/s², of motors at the ends of their range."""
    ends = product(airframe.thrust_range, repeat=4)
    turns = airframe.mixing[1:] @ np.array(list(ends)).T / np.array(airframe.inertia)[:, None]
    return float(np.linalg.norm(turns, axis=0).max())
