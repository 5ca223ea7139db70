"""A simulated Crazyflie that speaks CRTP to an unmodified cflib."""

__all__ = ["defaults", "faults", "firmware", "settings", "supervisor", "vehicle", "virtual_firmware"]
