"""Steering: programs, lines and sockets that change the path of a flight in the air."""

__all__ = [
    "connect",
    "recertify",
    "recorded_steering",
    "starting_vehicle",
    "steered_vehicle",
    "waypoint_lines",
]
