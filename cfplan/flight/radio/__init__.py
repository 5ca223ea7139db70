"""The link to the vehicle: URIs, the Crazyradio, its lock, connecting, perishable packets, parameters and logs."""

__all__ = ["connection", "crazyradio", "link", "perishable", "supervisor_bits", "uri"]
