"""A flight told to MAVLink ground stations, and their commands."""

__all__ = ["bridge"]
