"""Measured comparisons: each study makes one table or figure."""

__all__ = [
    "bench",
    "fault_scenarios",
    "faults",
    "feasibility",
    "flights",
    "lateness",
    "learned",
    "long_paths",
    "machine",
    "missions",
    "random_faults",
    "real_time",
    "scaling",
]
