"""The paper's tables and figures, one study each, beside the numbers that the paper prints (printed.py).

`networks`, `sequences`, `training` and `recovery` implement the paper's networks, `corridors`, `time_allocation`,
`bayesian_times`, `classifier` and `segment_times` its baselines; no planner of cfplan uses them.
"""
