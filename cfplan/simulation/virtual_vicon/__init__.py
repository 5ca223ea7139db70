"""A simulated Vicon system that speaks the DataStream protocol."""

__all__ = ["cameras", "faults", "server", "vicon"]
