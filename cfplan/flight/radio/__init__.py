"""The link to the vehicle: URIs, the Crazyradio, its lock, connecting, parameters and logs."""

__all__ = ["connection", "crazyradio", "link", "supervisor_bits", "uri"]
