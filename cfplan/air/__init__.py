"""Planning in the air: what a vehicle is bound to fly, and how requests change it while it flies.

Read timeline.py (what is committed and what is intended), replanning.py (turns a request into a certified proposal),
core.py (decides when to plan and how to answer), and then the core's two drivers: process.py in real time, stepped.py
on a stepped clock.
"""

__all__ = ["certifying", "process", "requests", "stepped", "stopping", "timeline"]
