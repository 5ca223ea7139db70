"""Setpoints as the bytes that are sent: packets, encoding, stops, descents, commitments, and hover-to-hover flights."""

__all__ = [
    "commitment", "descent", "encoding", "hover_to_hover", "motion_certificate", "packets", "rate_trade",
    "stop_certificate", "stops",
]  # fmt: skip
