"""Setpoints as the bytes that are sent: packets, encoding, stops, and hover-to-hover flights."""

__all__ = ["encoding", "hover_to_hover", "packets", "stop_certificate", "stops"]
