"""Hover to hover by setpoints: up to the height of take-off, and to the start of a plan.

While setpoints come, the vehicle's own time-outs watch over it: it levels out when they stop, and stops its motors
2 s later. Under the firmware's own high-level commander it would hover on without poses, and drift.
"""

import math

import numpy as np

from cfplan.flight.setpoints.encoding import controller_attitude
from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.flight.telemetry import Triple
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import about_z, quaternions_of


def hover_to_hover(
    begin: Triple, yaw: float, end: Triple, end_yaw: float, duration: float, rate: float
) -> FullStateSetpoints:
    """Return N rows at `rate`, Hz: straight from `begin` to `end`, m, in `duration`, s; yaw the shorter way.

    So slow a motion leans and rolls too little to be worth roll and pitch rates.
    """
    fraction = np.linspace(0.0, 1.0, max(round(duration * rate), 1) + 1)
    along = fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2)
    speed = 30.0 * fraction**2 * (1.0 - fraction) ** 2 / duration
    change = 60.0 * fraction * (1.0 - fraction) * (1.0 - 2.0 * fraction) / duration**2
    way, turn = np.subtract(end, begin), math.remainder(end_yaw - yaw, math.tau)
    zero = np.zeros_like(fraction)
    acceleration = change[:, None] * way
    leaning = controller_attitude(acceleration + np.array([0.0, 0.0, GRAVITY]), about_z(yaw + turn * along))
    return FullStateSetpoints(
        position=begin + along[:, None] * way,
        velocity=speed[:, None] * way,
        acceleration=acceleration,
        quaternion=quaternions_of(leaning),
        body_rate=np.stack([zero, zero, turn * speed], axis=1),
    )
