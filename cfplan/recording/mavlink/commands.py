"""Answer a ground station's commands: it may stop a flight; everything else is refused.

MAVLink is not authenticated, so commands that arm or move the vehicle are refused; a stop only makes things safer.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from cfplan.flight.pilot.keys import Order

# MAV_CMD
_RETURN, _LAND, _TAKE_OFF, _GUIDED = 20, 21, 22, 92
_SET_MODE, _REPOSITION, _TERMINATE = 176, 192, 185
_MOTOR_TEST, _REBOOT, _MISSION, _ARM = 209, 246, 300, 400
_REQUEST_MESSAGE, _REQUEST_VERSION = 512, 520
_REFUSED = (_RETURN, _TAKE_OFF, _GUIDED, _SET_MODE, _REPOSITION, _MOTOR_TEST, _REBOOT, _MISSION)
FORCE = 21196  # parameter that extends disarming to the air
AUTOPILOT_VERSION = 148  # the only message that can be requested


class Result(IntEnum):
    """MAV_RESULT"""

    ACCEPTED = 0
    DENIED = 2
    UNSUPPORTED = 3


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one command."""

    result: Result
    order: Order | None = None  # for the pilot
    text: str = ""  # sent to all ground stations as a status text
    message: int | None = None  # requested message


def answer(command: int, parameters: tuple[float, ...]) -> Answer:
    """Answer MAV_CMD `command` with its first two parameters, which may be any number or NaN."""
    first, second = parameters[:2]
    if command == _LAND:
        return Answer(Result.ACCEPTED, Order.LAND, "landing, as the ground station commands")
    if command == _TERMINATE and first > 0.5:
        return Answer(Result.ACCEPTED, Order.CUT, "motors off: flight termination")
    if command == _ARM and first == 0 and second == FORCE:
        return Answer(Result.ACCEPTED, Order.CUT, "motors off: forced disarm")
    if command in (_TERMINATE, _ARM, *_REFUSED):
        return Answer(Result.DENIED, text=f"refused: command {command}; ground stations may only stop a flight")
    if command == _REQUEST_VERSION or (command == _REQUEST_MESSAGE and first == AUTOPILOT_VERSION):
        return Answer(Result.ACCEPTED, message=AUTOPILOT_VERSION)
    return Answer(Result.UNSUPPORTED)


def command_of(message: Any) -> tuple[int, tuple[float, float]] | None:
    """Return the command in a COMMAND_LONG or COMMAND_INT; None for other messages."""
    if message.get_type() not in ("COMMAND_LONG", "COMMAND_INT"):
        return None
    return int(message.command), (float(message.param1), float(message.param2))
