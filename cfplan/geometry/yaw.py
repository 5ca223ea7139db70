"""The yaw modes: how the vehicle's heading along a path is chosen."""

from enum import StrEnum


class YawMode(StrEnum):
    """How yaw along a path is chosen."""

    FIXED = "fixed"  # one angle on the whole path
    TANGENT = "tangent"  # along the horizontal direction of flight
    FREE = "free"  # chosen by the planner
