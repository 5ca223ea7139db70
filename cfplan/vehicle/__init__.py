"""The vehicle: airframes, the flatness map, speed profiles, yaw, timing and trajectories."""

__all__ = [
    "airframe",
    "airframes",
    "correction",
    "flatness",
    "hover",
    "joint",
    "measures",
    "motion",
    "motor_commands",
    "profile",
    "profile_spline",
    "rotations",
    "timing",
    "trajectory",
    "trigonometry",
    "yaw_spline",
]
