"""Logs of other systems, read as flights: Vicon CSV, Crazyswarm, microSD, MAVLink, ROS bags."""

__all__ = ["mocap_log", "table", "vicon_header"]
