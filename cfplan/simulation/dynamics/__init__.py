"""The simulated body, the firmware's controller and estimator, and the closed loop of all three."""

__all__ = ["body", "branching", "closed_loop", "geometric", "kalman", "mellinger", "side_by_side"]
