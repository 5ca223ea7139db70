"""The vehicle: airframes, the flatness map, speed profiles, yaw, timing and trajectories."""

__all__ = [
    "airframe",
    "airframes",
    "correction",
    "dense",
    "flatness",
    "hover",
    "joint",
    "measures",
    "motor_commands",
    "panels",
    "profile",
    "profile_spline",
    "rotations",
    "timing",
    "trajectory",
    "trigonometry",
    "yaw_spline",
]
