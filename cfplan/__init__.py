"""cfplan: plan, certify, rehearse, fly and replay time-optimal Crazyflie flights."""

__version__ = "0.1.0"
