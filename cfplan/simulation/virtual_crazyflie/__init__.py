"""A simulated Crazyflie that speaks CRTP to an unmodified cflib."""

__all__ = ["faults", "settings", "stabilizer", "supervisor", "vehicle", "wire"]
