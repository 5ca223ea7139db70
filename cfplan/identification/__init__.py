"""Identification: what flights say about the vehicle and its latencies, each figure with its uncertainty."""

__all__ = [
    "advice",
    "airframe_yaml",
    "earlier_flights",
    "flight_log",
    "gains_file",
    "identify",
    "logged_flight",
    "measured",
    "quantities",
    "reference",
    "replay",
    "validate",
    "validation_page",
]
