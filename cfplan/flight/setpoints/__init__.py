"""Setpoints as the bytes that are sent: packets, encoding, stops, commitments, and hover-to-hover flights."""

__all__ = ["commitment", "encoding", "hover_to_hover", "packets", "rate_trade", "stop_certificate", "stops"]
