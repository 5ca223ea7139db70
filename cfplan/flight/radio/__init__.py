"""The link to the vehicle: URIs, Crazyradio, lock, connecting, the CRTP session and its transports, restart."""

__all__ = [
    "connection", "crazyradio", "crtp", "dongle", "link", "parameter_tables", "perishable", "radio_lock", "restart",
    "session", "supervisor_bits", "transport", "uri",
]  # fmt: skip
