"""The paper's tables, each by one study, beside what the paper prints; printed.py has its numbers."""

__all__ = [
    "all_tables",
    "architectures",
    "baselines",
    "expected_time",
    "figures",
    "hardware",
    "inputs",
    "networks",
    "printed",
    "robustness",
    "segment_times",
    "simulators",
    "trials",
    "yaw_consistency",
]
