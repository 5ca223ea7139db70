"""Write an identified airframe as a YAML file, and the lines of safety.yaml that go with it."""

import contextlib
import json
import os
import tempfile
from dataclasses import fields
from pathlib import Path

from cfplan.errors import InputError
from cfplan.identification.quantities import Identification
from cfplan.vehicle.airframe import Airframe

_KEPT_DIGITS = 7
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
        else:
            text = _number(value)
        unit = f"  # {_UNITS[each.name]}" if each.name in _UNITS else ""
        lines.append(f"{each.name}: {text}{unit}")
    return "\n".join(lines) + "\n"


def safety_lines(found: Identification, file: Path) -> str:
    """Return the lines of safety.yaml that make flights use what was found; none for poses that are dated right."""
    pose = f"pose:\n  latency: {found.pose_latency:.4f}\n" if found.poses_misdated else ""
    return f"vehicle: {file.name}\n{pose}"


def check_target(file: Path, *, overwrite: bool = False) -> None:
    """Raise InputError where an airframe's file may not be written."""
    if file.suffix not in (".yaml", ".yml"):
        raise InputError("an airframe is a .yaml file", where=str(file), hint="end the file's name in .yaml")
    if file.exists() and not overwrite:
        raise InputError("exists already", where=str(file), hint="--force overwrites it")
    if not file.parent.is_dir():
        raise InputError("no such folder", where=str(file.parent), hint="make it first")


def write_airframe(airframe: Airframe, file: Path, *, overwrite: bool = False) -> None:
    """Write the airframe's file, whole or not at all. Raises InputError where it exists or cannot be written."""
    check_target(file, overwrite=overwrite)
    unfinished = None
    try:
        with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=file.parent, delete=False) as stream:
            unfinished = Path(stream.name)
            stream.write(airframe_text(airframe))
        unfinished.chmod(0o666 & ~_umask())
        unfinished.replace(file)
    except OSError as error:
        if unfinished is not None:
            with contextlib.suppress(OSError):
                unfinished.unlink()
        raise InputError(
            f"cannot be written ({error.strerror or error})", where=str(file), hint="choose another with -o"
        ) from error


def _number(value: float) -> str:
    text = f"{value:.{_KEPT_DIGITS}g}"
    return text.replace("e", ".0e") if "e" in text and "." not in text else text  # YAML reads 1e-05 as text


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
