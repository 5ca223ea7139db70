"""From a path and limits to a certified plan: the choice of planner, repair, and plan files."""

__all__ = [
    "active_limits",
    "continuation",
    "figure",
    "fleet",
    "path",
    "plan",
    "plan_file",
    "plan_result",
    "planners",
    "repair",
]
