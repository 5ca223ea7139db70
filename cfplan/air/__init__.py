"""Planning in the air: what a vehicle is bound to fly, and how requests change it while it flies.

Read timeline.py (what is committed and what is intended), replanning.py (from a request to a certified proposal),
core.py (when that is done, and what is answered), and then its two drivers: process.py in real time, stepped.py on a
stepped clock.
"""

__all__ = ["certifying", "process", "requests", "stepped", "stopping", "timeline"]
