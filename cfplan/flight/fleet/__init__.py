"""Flights of several vehicles: the conductor, which starts and brakes them together, and Crazyradios they share."""

__all__ = ["conductor", "dongle_process", "fly_together", "inline_radio"]
