"""The pilot: its phases, preflight, the stream of setpoints, the abort ladder, and its process."""

__all__ = [
    "conducted",
    "deadlines",
    "health",
    "keys",
    "mission",
    "outcome",
    "pilot",
    "process",
    "proposals",
    "vehicle_rules",
    "vehicle_survey",
]
