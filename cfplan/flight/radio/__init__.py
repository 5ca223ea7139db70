"""The link to the vehicle: URIs, Crazyradio, lock, connecting, the CRTP session and its transports, restart."""

__all__ = [
    "connection", "crazyradio", "crtp", "dongle", "link", "perishable", "restart", "session", "supervisor_bits",
    "table", "transport", "uri",
]  # fmt: skip
