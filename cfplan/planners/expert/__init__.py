"""The expert planner: the fastest profile that keeps every limit, and refining from a near-feasible one."""

__all__ = ["expert", "intersample", "sensitivity", "windows"]
