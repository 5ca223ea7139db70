"""The path through waypoints that is flown soonest."""

__all__ = ["choice"]
