"""Measured comparisons: each study makes one table or figure."""

__all__ = [
    "bench",
    "docs_tables",
    "fault_scenarios",
    "faults",
    "feasibility",
    "flights",
    "lateness",
    "learned",
    "long_paths",
    "machine",
    "provenance",
    "random_faults",
    "real_time",
    "result",
    "scaling",
]
