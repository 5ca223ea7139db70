"""Identification: estimate a vehicle's parameters and latencies from its flights, with their uncertainties."""

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
