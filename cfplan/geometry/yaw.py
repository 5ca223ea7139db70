"""Which way the vehicle points along a path."""

from enum import StrEnum


class YawMode(StrEnum):
    """How yaw is chosen."""

    FIXED = "fixed"  # one angle all along
    TANGENT = "tangent"  # along the horizontal direction of flight
    FREE = "free"  # left to the planner
