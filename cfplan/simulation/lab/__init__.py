"""The virtual lab: vehicle, radio and cameras together, in real time or stepped."""

__all__ = ["downwash", "lab", "radio", "room", "sim_driver", "stepped_fleet", "stepped_lab", "stepped_link"]
