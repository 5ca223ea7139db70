"""Setpoints as the bytes that are sent: packets, encoding, stops, and hover-to-hover flights."""

__all__ = ["encoding", "hover_to_hover", "packets", "rate_trade", "stop_certificate", "stops"]
