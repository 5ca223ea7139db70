"""Poses from motion capture: sources, the Vicon DataStream, and the tracker that judges poses."""

__all__ = [
    "datastream",
    "dead_reckoning",
    "frames",
    "pose_check",
    "pose_tracker",
    "poses",
    "source",
    "survey",
    "uri",
]
