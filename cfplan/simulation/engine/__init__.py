"""The simulator: body, controllers, estimator and supervisor's time-outs, for a batch of vehicles at once."""

__all__ = ["body", "estimated_loop", "flight", "geometric", "kalman", "layout", "lee", "mellinger", "pid", "run"]
