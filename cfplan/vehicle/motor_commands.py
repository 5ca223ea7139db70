"""Convert logged motor commands: PWM after battery compensation to and from fractions of the full command before it.

The firmware converts a fraction of its full command to thrust, thrust to motor voltage by a cubic of the propeller
build, and the ratio of motor to battery voltage to PWM. Firmware without compensation logs the fractions themselves.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.vehicle.airframe import Airframe

FULL_COMMAND = 65535  # of a motor, 16 bits
_LEAST_VOLTAGE = 2.0  # V of the battery, below which the firmware turns the motors off
_UNIQUE = 1.0 - 1e-6  # of the least thrust, so that rounding does not turn off a motor at that thrust
_ROUNDS = 40  # of bisection: to 1e-11 V


def command_shares(pwm: NDArray, battery_voltage: NDArray, airframe: Airframe) -> NDArray:
    """Return the fraction of the full command, (N, 4), from PWM, (N, 4) 16 bits, logged at battery voltages, (N,) V."""
    share = np.asarray(pwm) / FULL_COMMAND
    if not any(airframe.motor_curve):
        return share
    *cubic, full = airframe.motor_curve
    thrust = np.polynomial.polynomial.polyval(share * np.asarray(battery_voltage)[:, None], cubic)
    return np.where(share > 0.0, np.maximum(thrust, 0.0) / full, 0.0)


def compensated_pwm(share: float, battery_voltage: float, airframe: Airframe) -> float:
    """Return the PWM, 16 bits, for a fraction of the full command at a battery voltage, V."""
    if not any(airframe.motor_curve):
        return share * FULL_COMMAND
    *cubic, full = airframe.motor_curve
    thrust = share * full
    if thrust < _UNIQUE * airframe.motor_thrust_min or battery_voltage < _LEAST_VOLTAGE:
        return 0.0
    low, high = 0.0, 2.0 * battery_voltage
    for _ in range(_ROUNDS):
        middle = 0.5 * (low + high)
        given = cubic[0] + middle * (cubic[1] + middle * (cubic[2] + middle * cubic[3]))
        low, high = (middle, high) if given < thrust else (low, middle)
    return min(low / battery_voltage, 1.0) * FULL_COMMAND
