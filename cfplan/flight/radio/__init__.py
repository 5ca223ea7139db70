"""The link to the vehicle: URIs, Crazyradio, lock, connecting, perishable packets, parameters, logs, restart."""

__all__ = ["connection", "crazyradio", "link", "log_block", "perishable", "restart", "supervisor_bits", "uri"]
