"""Planners of the speed profile: the expert, its solver, and the baselines that it is measured against."""

__all__ = ["baselines", "expert", "solution"]
