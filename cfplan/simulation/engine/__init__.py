"""The simulator: body, controllers, estimator and supervisor's time-outs, for a batch of vehicles at once."""

__all__ = ["body", "flight", "geometric", "kalman", "layout", "mellinger", "pid", "run"]
