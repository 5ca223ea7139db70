"""Logs of other systems, read as flights: Vicon CSV, Crazyswarm, microSD, MAVLink, ROS bags."""

__all__ = ["formats", "mocap_log", "usd_log", "vicon_header"]
