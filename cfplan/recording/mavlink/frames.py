"""Convert axes: cfplan (world z up, body forward, left, up) to MAVLink (north, east, down; forward, right, down).

A laboratory has no north: its y axis is sent as north and its x axis as east, so that yaw has the right sense and a log
reads back in its original orientation. Quaternions are x y z w here and w x y z there.
"""

import math

from cfplan.flight.telemetry import Quaternion, Triple
from cfplan.vehicle.rotations import roll_pitch_of, yaw_of

_HALF = math.sqrt(0.5)


def ned(vector: Triple) -> Triple:
    """Convert a vector in world axes."""
    x, y, z = vector
    return y, x, -z


def frd(vector: Triple) -> Triple:
    """Convert a vector in body axes."""
    x, y, z = vector
    return x, -y, -z


def attitude(quaternion: Quaternion) -> Quaternion:
    """Convert body→world, x y z w, to (w, x, y, z) from forward, right, down to north, east, down."""
    x, y, z, w = quaternion
    return _HALF * (w + z), _HALF * (x + y), _HALF * (x - y), _HALF * (w - z)


def in_body(vector: Triple, quaternion: Quaternion) -> Triple:
    """Turn a vector in world axes into the axes of the body that has this attitude."""
    x, y, z, w = quaternion
    vx, vy, vz = vector
    # v + 2 u × (u × v + w v) with the conjugate, u = (-x, -y, -z)
    cx, cy, cz = -(y * vz - z * vy) + w * vx, -(z * vx - x * vz) + w * vy, -(x * vy - y * vx) + w * vz
    return vx - 2 * (y * cz - z * cy), vy - 2 * (z * cx - x * cz), vz - 2 * (x * cy - y * cx)


def euler(wxyz: Quaternion) -> Triple:
    """Return roll, pitch, yaw, rad, of an attitude as MAVLink has it; yaw is clockwise from north."""
    w, x, y, z = wxyz
    roll, pitch = roll_pitch_of((x, y, z, w))
    return float(roll), float(pitch), float(yaw_of((x, y, z, w)))
