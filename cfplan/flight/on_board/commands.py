"""Commands to the on-board high-level commander (CRTP port 8), as bytes; it answers each with a code.

The commander's answer begins with the command's number and has the code in its fourth byte. Yaw is in rad.
"""

import struct

DEFINE, STOP, TAKE_OFF, LAND, GO_TO, START = 6, 3, 7, 8, 12, 13
DONE, BUSY = 0, 1
ANSWERS = {BUSY: "its planner is busy", 8: "it cannot carry that out", 16: "its supervisor does not let it fly"}
TRAJECTORY = 1  # the number under which a trajectory is defined
_ALL, _IN_MEMORY = 0, 1  # groups; where a trajectory is


def define(pieces: int, *, compressed: bool) -> bytes:
    """Return the command that defines what lies at the beginning of the trajectory memory as TRAJECTORY."""
    return struct.pack("<BBBBIB", DEFINE, TRAJECTORY, _IN_MEMORY, int(compressed), 0, pieces)


def take_off(height: float, duration: float) -> bytes:
    """Return the command to climb to a height, m, in `duration`, s, with the yaw that the vehicle has."""
    return struct.pack("<BBff?f", TAKE_OFF, _ALL, height, 0.0, True, duration)


def land(height: float, duration: float) -> bytes:
    """Return the command to sink to a height, m, in `duration`, s, and to stop the motors then."""
    return struct.pack("<BBff?f", LAND, _ALL, height, 0.0, True, duration)


def go_to(x: float, y: float, z: float, yaw: float, duration: float) -> bytes:
    """Return the command to fly to a place, m and rad, and to hover there; from any motion."""
    return struct.pack("<BB??fffff", GO_TO, _ALL, False, False, x, y, z, yaw, duration)


def start() -> bytes:
    """Return the command to fly TRAJECTORY, where it lies in the room and at its own pace."""
    return struct.pack("<BB???Bf", START, _ALL, False, False, False, TRAJECTORY, 1.0)


def stop() -> bytes:
    """Return the command that stops the motors."""
    return struct.pack("<BB", STOP, _ALL)
