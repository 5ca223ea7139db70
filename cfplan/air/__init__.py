"""Planning in the air: what a vehicle is bound to fly, and how requests change it while it flies.

The pilot streams setpoints that are committed: certified, with a stop from each, and at rest in the end. On a request
the planner chooses a splice, the number of a setpoint so far ahead of the clock that the proposal can be in time. The
joint is the moment of the motion at which that setpoint was sampled.

    before the joint   setpoints keep their bytes, which were certified with what they look ahead at
    at the joint       the proposal begins with the committed setpoint; from here on the new plan is flown, which begins
                       in the very state of the old one (planning/continuation.py)
    behind the joint   setpoints, stops and link loss are certified as before take-off, from the simulated vehicle at
                       the joint; the pilot verifies the bytes and splices them in, or flies on as if nothing had come

Read timeline.py (what is committed and what is intended), replanning.py (turns a request into a certified proposal),
core.py (decides when to plan and how to answer), and then the core's two drivers: process.py in real time, stepped.py
on a stepped clock.
"""

__all__ = ["certifying", "process", "requests", "stepped", "stopping", "timeline"]
