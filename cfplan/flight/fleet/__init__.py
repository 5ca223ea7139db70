"""Flights of several vehicles: the conductor, which starts them together and lets all brake when one must."""

__all__ = ["conductor", "dongle_process", "fly_together", "inline_radio"]
