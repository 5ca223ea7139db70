"""MAVLink telemetry to ground stations during a flight, and their commands."""

__all__ = ["bridge"]
