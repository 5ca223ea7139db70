"""Flights, plans and logs shown in rerun."""

__all__ = ["live", "overlay_view", "record_view", "viewer"]
