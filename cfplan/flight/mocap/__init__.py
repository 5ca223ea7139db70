"""Poses from motion capture: sources, the Vicon DataStream, and the gates that poses pass."""

__all__ = [
    "datastream",
    "dead_reckoning",
    "frames",
    "pose_gate",
    "pose_predictor",
    "pose_steps",
    "poses",
    "source",
    "survey",
    "uri",
]
