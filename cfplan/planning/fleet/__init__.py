"""Several vehicles: start delays and clock rates that keep them apart, and the certificate of that."""

__all__ = ["coordination", "fleet_file", "lost", "members", "separation"]
