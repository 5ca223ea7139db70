"""Planners of the speed profile: the task and its solution, the expert, its solver, and baselines to compare with."""

__all__ = ["baselines", "expert", "solution", "task"]
