"""The paper's tables and figures, each by one study, beside what the paper prints; printed.py has its numbers.

`networks`, `sequences`, `training` and `recovery` are the paper's networks, `corridors`, `time_allocation`,
`bayesian_times`, `classifier` and `segment_times` its baselines; no planner of cfplan uses them.
"""
