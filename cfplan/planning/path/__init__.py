"""The choice of the fastest path through waypoints."""

__all__ = ["choice", "onward", "search", "variables"]
