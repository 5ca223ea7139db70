"""Read an airframe from a YAML file with the fields, units and ranges of Airframe."""

from pathlib import Path

from cfplan.errors import InputError
from cfplan.files.schema import read_as, schema_of
from cfplan.files.yaml_with_places import read_yaml_with_places
from cfplan.vehicle.airframe import Airframe

_AirframeFile = schema_of(Airframe)


def read_airframe(file: Path | str) -> Airframe:
    """Read the airframe that a file describes.

    Raises:
        InputError: with `file:line:column`, also for one that cannot hover.
    """
    content, places = read_yaml_with_places(file, _AirframeFile)
    airframe = read_as(Airframe, content)
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
