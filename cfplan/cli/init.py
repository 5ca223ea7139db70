"""`cfplan init`: write a safety.yaml for a room, and a first path in it."""

import re
from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json
from cfplan.errors import InputError

_ROOM = "4.5x8x2"
_MIN_SIDE, _MIN_HEIGHT, _MAX_SIDE, _MAX_HEIGHT = 1.5, 1.2, 60.0, 30.0  # m; setpoints hold 32 m
_CLIMB = 0.5  # m, at most
_FILL = 0.6  # fraction of the room within the margin that the first path fills; link loss needs the rest
_PATH_FILE, _AIRFRAME_FILE = "first.yaml", "airframe.yaml"


@click.command(
    short_help="Write a safety.yaml and a first path for a room.",
    epilog="""\b
Examples:
  cfplan init --room 4x6x2.5                        here
  cfplan init mylab --room 4x6x2.5 --mass 0.0334    in mylab/, for a vehicle that was weighed
  cfplan fly first.yaml                             then, on the virtual Crazyflie""",
)
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default=Path())
@click.option(
    "--room",
    default=_ROOM,
    show_default=True,
    help="Size along x, y and z, m; the origin is in the middle of the floor.",
)
@click.option("--vehicle", default="crazyflie-2.1+", show_default=True, help="Name of a known airframe.")
@click.option("--mass", type=float, help="Mass with battery and markers, kg; also writes an airframe file.")
@options.as_json
def init(folder: Path, room: str, vehicle: str, mass: float | None, as_json: bool) -> None:
    """Write a commented safety.yaml and a first path for a room into FOLDER. Existing files are never changed."""
    from cfplan.safety.limits_file import load_limits

    steps = Steps(as_json=as_json)
    sides = _sides(room)
    airframe = _airframe(vehicle, mass)
    texts = {
        options.SAFETY_FILE: _safety_text(sides, vehicle if airframe is None else _AIRFRAME_FILE),
        _PATH_FILE: _path_text(sides),
        **({_AIRFRAME_FILE: airframe} if airframe is not None else {}),
    }
    for name in texts:
        if (folder / name).exists():
            raise InputError("the file already exists", where=str(folder / name), hint="name another folder")
    with steps.step("write") as results:
        _write(folder, texts)
        load_limits(folder / options.SAFETY_FILE)
        results.append(", ".join(str(folder / name) for name in texts))
    steps.print(f"measure the room, correct safety.yaml, then: cfplan fly {folder / _PATH_FILE}")
    if as_json:
        print_json({"files": [str(folder / name) for name in texts]})


def _sides(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(side) for side in text.lower().split("x"))
    except ValueError:
        raise InputError(
            f"{text!r} is not a room size", where="--room", hint=f"write length x width x height, as {_ROOM}"
        ) from None
    if not (min(x, y) >= _MIN_SIDE and max(x, y) <= _MAX_SIDE and _MIN_HEIGHT <= z <= _MAX_HEIGHT):
        raise InputError(
            f"a room of {x:g} m by {y:g} m, {z:g} m high",
            where="--room",
            hint=f"write metres: {_MIN_SIDE:g} to {_MAX_SIDE:g} a side, {_MIN_HEIGHT:g} to {_MAX_HEIGHT:g} high",
        )
    return x, y, z


def _airframe(vehicle: str, mass: float | None) -> str | None:
    """Return the text of an airframe with this mass, kg; None if the known airframe is used unchanged."""
    from dataclasses import replace

    from cfplan.identification.airframe_yaml import airframe_text
    from cfplan.vehicle.airframes import load_airframe

    known = load_airframe(vehicle)
    if mass is None:
        return None
    if not 0.5 * known.mass <= mass <= 2.0 * known.mass:
        raise InputError(
            f"{mass:g} kg is implausible for a {vehicle} of about {known.mass:g} kg",
            where="--mass",
            hint="weigh it with battery and markers, and write kilograms",
        )
    weighed = replace(known, name=f"{vehicle} of {1000 * mass:g} g", mass=mass, source=f"{known.source}; mass weighed")
    return airframe_text(weighed)


def _safety_text(sides: tuple[float, float, float], vehicle: str) -> str:
    from cfplan.safety.limits_file import DEFAULTS

    x, y, z = sides
    text = DEFAULTS.read_text(encoding="utf-8")
    for pattern, line in (
        (r"^vehicle: \S+", f"vehicle: {vehicle}"),
        (r"^  low: \[.*?\]", f"  low: [{-x / 2:g}, {-y / 2:g}, 0.0]"),
        (r"^  high: \[.*?\]", f"  high: [{x / 2:g}, {y / 2:g}, {z:g}]"),
    ):
        text, count = re.subn(pattern, line, text, count=1, flags=re.MULTILINE)
        assert count == 1, pattern
    return text


def _path_text(sides: tuple[float, float, float]) -> str:
    """Return a path file with a loop around the middle of the room, at half its height, that climbs a little."""
    from cfplan.safety.limits_file import DEFAULTS, load_limits

    margin = load_limits(DEFAULTS).space.margin
    a, b = (round(_FILL * (side / 2 - margin), 2) for side in sides[:2])
    low = round(min(1.0, sides[2] / 2), 2)
    high = round(low + min(_FILL * (sides[2] - margin - low) / 2, _CLIMB), 2)
    return f"""\
# A first path: a loop around the middle of the room. Fly it, look at it with `cfplan replay`, then change it.
name: first
waypoints:            # m, in the frame of motion capture: x, y, height
  - [0, {-b}, {low}]
  - [{a}, 0, {high}]
  - [0, {b}, {low}]
  - [{-a}, 0, {high}]
  - [0, {-b}, {low}]
yaw: fixed            # or tangent, free, or {{mode: fixed, angle_deg: 90}}
speed: 0.5            # factor on the speed that safety.yaml allows
"""


def _write(folder: Path, texts: dict[str, str]) -> None:
    """Write all files or none, without ever overwriting one, not even one created meanwhile. Raises InputError."""
    written: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            with (folder / name).open("x", encoding="utf-8") as stream:
                written.append(folder / name)
                stream.write(text)
    except OSError as error:
        for file in written:
            file.unlink()
        raise InputError(
            f"cannot be written ({error.strerror or error})", where=str(folder), hint="name another folder"
        ) from error
