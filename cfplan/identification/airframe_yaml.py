"""Write an identified airframe as a YAML file, and the lines of safety.yaml that go with it."""

import json
from dataclasses import fields
from pathlib import Path

from cfplan.files.atomic import check_new_file, write_atomically
from cfplan.identification.quantities import Identification
from cfplan.vehicle.airframe import Airframe, Spread

_DIGITS = 7
_UNITS = {
    "mass": "kg, with the battery",
    "inertia": "kg m²",
    "arm": "m",
    "thrust_to_torque": "m",
    "motor_thrust_min": "N",
    "motor_thrust_max": "N",
    "motor_time_constant": "s",
    "drag": "N s/m, in the rotor plane and along the thrust axis",
    "rotor_reaction": "N m s/N",
    "velocity_moment": "N m per m/s, about x by velocity along y, and about -y by velocity along x",
    "thrust_scale": "actual over commanded thrust in hover",
    "thrust_curvature": "1 less the slope of thrust over its scale, in hover",
    "lift_with_speed": "1/(m/s)², gain of thrust",
    "voltage_sag": "1/V, fraction of thrust lost; 0 with battery compensation",
    "motor_curve": "the firmware's cubic from V of a motor to N, and N of the full command; for logged PWM",
    "spread": "half the width of 95 %, as fractions of each value",
}


def airframe_text(airframe: Airframe) -> str:
    """Return the airframe as YAML that `vehicle:` of safety.yaml can name."""
    lines = []
    for each in fields(Airframe):
        value = getattr(airframe, each.name)
        if isinstance(value, str):
            text = json.dumps(value, ensure_ascii=False)
        elif isinstance(value, tuple):
            text = "[" + ", ".join(_number(part) for part in value) + "]"
        elif isinstance(value, Spread):
            parts = (f"{part.name}: {_number(getattr(value, part.name))}" for part in fields(Spread))
            text = "{" + ", ".join(parts) + "}"
        else:
            text = _number(value)
        unit = f"  # {_UNITS[each.name]}" if each.name in _UNITS else ""
        lines.append(f"{each.name}: {text}{unit}")
    return "\n".join(lines) + "\n"


def safety_lines(found: Identification, file: Path) -> str:
    """Return the lines of safety.yaml that make flights use what was found; none if poses are dated correctly."""
    pose = f"pose:\n  latency: {found.pose_latency:.4f}\n" if found.poses_misdated else ""
    return f"vehicle: {file.name}\n{pose}"


def check_target(file: Path, *, overwrite: bool = False) -> None:
    """Raise InputError where an airframe's file may not be written."""
    check_new_file(file, ".yaml", ".yml", overwrite=overwrite)


def write_airframe(airframe: Airframe, file: Path, *, overwrite: bool = False) -> None:
    """Write the airframe's file atomically. Raises InputError where it exists or cannot be written."""
    check_target(file, overwrite=overwrite)
    write_atomically(file, airframe_text(airframe).encode())


def _number(value: float) -> str:
    text = f"{value:.{_DIGITS}g}"
    return text.replace("e", ".0e") if "e" in text and "." not in text else text  # YAML reads 1e-05 as text
