"""Read an airframe from a YAML file with the fields and units of Airframe."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cfplan.errors import InputError
from cfplan.files.yaml_with_places import read_yaml_with_places
from cfplan.vehicle.airframe import Airframe, Spread, airframe_of

# Bounds far beyond vehicles that fly indoors; larger values would lose digits, or have a wrong unit.
Inertia = Annotated[float, Field(ge=1e-8, le=1.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Coefficient = Annotated[float, Field(ge=-10.0, le=10.0)]
Moment = Annotated[float, Field(ge=0.0, le=0.1)]
_USUAL = Spread()
Drag = Annotated[float, Field(ge=0.0, le=10.0)]


class _SpreadFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mass: Fraction = _USUAL.mass
    thrust_scale: Fraction = _USUAL.thrust_scale
    drag: Fraction = _USUAL.drag
    velocity_moment: Fraction = _USUAL.velocity_moment
    motor_time_constant: Fraction = _USUAL.motor_time_constant


class _AirframeFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: Annotated[str, Field(min_length=1, max_length=100)]
    mass: Annotated[float, Field(ge=1e-3, le=10.0)]
    inertia: tuple[Inertia, Inertia, Inertia]
    arm: Annotated[float, Field(ge=1e-3, le=1.0)]
    thrust_to_torque: Annotated[float, Field(ge=1e-6, le=1.0)]
    motor_thrust_min: Annotated[float, Field(ge=0.0, le=100.0)]
    motor_thrust_max: Annotated[float, Field(gt=0.0, le=100.0)]
    motor_time_constant: Annotated[float, Field(ge=1e-4, le=1.0)]
    drag: tuple[Drag, Drag]
    source: Annotated[str, Field(min_length=1, max_length=1000)]
    rotor_reaction: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    velocity_moment: tuple[Moment, Moment] = (0.0, 0.0)
    thrust_scale: Annotated[float, Field(ge=0.2, le=5.0)] = 1.0
    thrust_curvature: Annotated[float, Field(ge=-0.9, le=0.9)] = 0.0
    lift_with_speed: Annotated[float, Field(ge=-0.1, le=0.1)] = 0.0
    voltage_sag: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    motor_curve: tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient] = (0.0, 0.0, 0.0, 0.0, 0.0)
    spread: _SpreadFile = _SpreadFile()


def read_airframe(file: Path | str) -> Airframe:
    """Read the airframe that a file describes.

    Raises:
        InputError: with `file:line:column`, also for one that cannot hover.
    """
    content, places = read_yaml_with_places(file, _AirframeFile)
    airframe = airframe_of(content.model_dump())
    least, most = airframe.thrust_range
    if not least < airframe.hover_thrust < most:
        raise InputError(
            f"it cannot hover: each motor needs {airframe.hover_thrust:.3g} N and gives {least:.4g} to {most:.4g} N",
            where=places.where("motor_thrust_max"),
            hint="masses are in kg, thrusts in N for one motor",
        )
    jx, jy, jz = sorted(airframe.inertia)
    if jz > jx + jy:
        raise InputError(
            "no rigid body has these moments of inertia: one exceeds the sum of the others",
            where=places.where("inertia"),
            hint="write the moments about x, y and z in kg m²",
        )
    return airframe
