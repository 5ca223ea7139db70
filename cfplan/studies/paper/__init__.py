"""The paper's tables, each by one study, beside what the paper prints: architectures, inputs, robustness, baselines."""

__all__ = [
    "all_tables",
    "architectures",
    "baselines",
    "inputs",
    "networks",
    "printed",
    "robustness",
    "trials",
    "yaw_consistency",
]
