"""Setpoints as the bytes that are sent: packets, encoding, stops, descents, commitments, and hover-to-hover flights."""

__all__ = [
    "byte_check", "commitment", "descent", "encoding", "hover_to_hover", "level_out", "motion_certificate", "packets",
    "rate_trade", "stop_certificate", "stops",
]  # fmt: skip
