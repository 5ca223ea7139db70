"""Steering: programs, lines and sockets that change the path of a flight in the air."""

__all__ = [
    "connect",
    "connected_fleet",
    "fleet_addresses",
    "fleet_room",
    "flight_in_progress",
    "real_time_steering",
    "recertify",
    "recorded_steering",
    "starting_vehicle",
    "steered_vehicle",
    "stepped_steering",
    "waypoint_lines",
]
