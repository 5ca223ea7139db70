"""The paper's tables, each by one study, beside what the paper prints: architectures, inputs, robustness."""

__all__ = ["all_tables", "architectures", "inputs", "networks", "printed", "robustness", "trials", "yaw_consistency"]
