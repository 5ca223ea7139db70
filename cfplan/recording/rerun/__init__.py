"""Flights, plans and logs shown in rerun."""

__all__ = ["fleet_view", "live", "overlay_view", "record_view", "viewer"]
