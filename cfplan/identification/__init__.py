"""Identification: what flights say about the vehicle and its latencies, each figure with its uncertainty."""

__all__ = ["advice", "airframe_yaml", "identify", "quantities"]
