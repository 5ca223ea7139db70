"""Hover to hover by setpoints: to the start of a plan, and down if the on-board commander does not land.

While setpoints come, the vehicle's own time-outs watch over it: it levels out when they stop, and stops its motors
2 s later. In the hands of its on-board commander it would hover on without poses, and drift.
"""

import math

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.packets import FullStateSetpoints, encode
from cfplan.flight.telemetry import Triple
from cfplan.vehicle.rotations import about_z


def encode_hover_to_hover(
    begin: Triple, yaw: float, end: Triple, end_yaw: float, duration: float, rate: float
) -> NDArray:
    """Return (N, 29) uint8 at `rate`, Hz: straight from `begin` to `end`, m, in `duration`, s; yaw the shorter way."""
    share = np.linspace(0.0, 1.0, max(round(duration * rate), 1) + 1)
    along = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    speed = 30.0 * share**2 * (1.0 - share) ** 2 / duration
    change = 60.0 * share * (1.0 - share) * (1.0 - 2.0 * share) / duration**2
    way, turn = np.subtract(end, begin), math.remainder(end_yaw - yaw, math.tau)
    zero = np.zeros_like(share)
    return encode(
        FullStateSetpoints(
            position=begin + along[:, None] * way,
            velocity=speed[:, None] * way,
            acceleration=change[:, None] * way,
            quaternion=about_z(yaw + turn * along),
            body_rate=np.stack([zero, zero, turn * speed], axis=1),
        )
    )
