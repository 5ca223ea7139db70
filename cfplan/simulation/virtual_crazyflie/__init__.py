"""A simulated Crazyflie that speaks CRTP to an unmodified cflib."""

__all__ = ["faults", "log_variables", "settings", "stabilizer", "supervisor", "vehicle"]
