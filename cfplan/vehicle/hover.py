"""Hover: the trajectory of a vehicle that stays in place, with which a flight without a path begins."""

import numpy as np

from cfplan.geometry.path import Path
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory


def hover_at(position: tuple[float, float, float], yaw: float, duration: float, airframe: Airframe) -> Trajectory:
    """Return the trajectory that stays at a position, m, with a yaw, rad, for `duration`, s: a path without length."""
    nodes, none = np.array([0.0, duration / 2, duration]), np.zeros(3)
    path = Path(nodes, np.tile(np.array(position, dtype=float), (2, 1, 1)).reshape(2, 1, 3))
    turned = np.full(3, float(yaw))
    return Trajectory(path, SpeedProfile(nodes, none + 1.0, none, none, none[:2], turned, none, none[:2]), airframe)
