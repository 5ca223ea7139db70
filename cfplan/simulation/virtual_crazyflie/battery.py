"""A battery of one cell: voltage falls with the charge used and, at once, with the current drawn.

The firmware compensates a falling voltage by the duty cycle until that is full: measured at 3.0, 3.5 and 3.7 V, a motor
of the 2.1+ gives 0.113, 0.166 and 0.193 N at most, and is never commanded to more than 0.12 N.
"""

CAPACITY = 250e-3 * 3600  # A s
_RESISTANCE = 0.2  # Ω: 4.2 V at rest and 3.30 V at 4.44 A, Bitcraze's table of thrust and current
_CURRENT, _AT_THRUST = 4.44, 0.568  # A at N, the same table
_IDLE_CURRENT = 0.15  # A
_EMPTY, _FULL = 3.5, 4.18  # V at rest
# V, above which a motor gives its commanded thrust; fraction lost per V below that
_FULL_ABOVE, _LOSS = 3.066, 0.106 / 0.12


class Battery:
    """A battery; `charge` is the remaining fraction of its capacity."""

    def __init__(self, charge: float = 1.0, capacity: float = CAPACITY):
        self.charge, self._capacity = charge, capacity  # A s
        self.voltage = self._at_rest
        self.sag = 0.0  # V by which the voltage is lower than a healthy battery's

    @property
    def _at_rest(self) -> float:
        return _EMPTY + (_FULL - _EMPTY) * self.charge

    def drain(self, thrust: float, seconds: float) -> None:
        """Draw the current for `thrust`, N, of all motors together, for some seconds."""
        current = _IDLE_CURRENT + _CURRENT * (max(thrust, 0.0) / _AT_THRUST) ** 1.5
        self.charge = max(0.0, self.charge - current * seconds / self._capacity)
        self.voltage = self._at_rest - _RESISTANCE * current - self.sag

    @property
    def strength(self) -> float:
        """Return the fraction of its largest thrust that a motor can give at this voltage."""
        return min(1.0, max(0.0, 1.0 - _LOSS * (_FULL_ABOVE - self.voltage)))
