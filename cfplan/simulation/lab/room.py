"""The room of a lab: its motion capture, and the address under which its vehicle is found."""

import os
from dataclasses import dataclass, field

from cfplan.errors import InputError
from cfplan.simulation.virtual_vicon.cameras import ViconSettings


@dataclass(frozen=True, slots=True)
class RoomSettings:
    """Settings of a room, whose virtual Vicon sees all vehicles."""

    vicon: ViconSettings = field(default_factory=ViconSettings)
    on_board: bool = False  # vehicles have the poses themselves, as from a positioning deck; there is no server


def lab_address(number: int) -> tuple[str, int] | None:
    """Return the address of the lab of that number, None if there is none. Raises InputError if it is malformed."""
    name = lab_variable(number)
    text = os.environ.get(name)
    if text is None:
        return None
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise InputError(f"{text!r} is not host:port", where=name, hint="let a lab set this variable")
    return host, int(port)


def lab_variable(number: int) -> str:
    """Return the environment variable with the address of a lab."""
    return f"CFPLAN_SIM_{number}"
