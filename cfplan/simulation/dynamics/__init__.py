"""The simulated body, the firmware's controller and estimator, and the closed loop of all three."""

__all__ = [
    "body",
    "branching",
    "closed_loop",
    "estimated_loop",
    "geometric",
    "kalman",
    "lee",
    "mellinger",
    "side_by_side",
]
