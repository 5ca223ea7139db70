"""Flights of several vehicles: the conductor, which starts them together and lets all brake when one must."""

__all__ = ["conductor", "fly_together"]
