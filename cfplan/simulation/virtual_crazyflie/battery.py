"""A battery of one cell: voltage falls with the charge used and, at once, with the current drawn."""

_CAPACITY = 250e-3 * 3600  # A s
_RESISTANCE = 0.2  # Ω: 4.2 V at rest and 3.30 V at 4.44 A, Bitcraze's table of thrust and current
_CURRENT, _AT_THRUST = 4.44, 0.568  # A at N, the same table
_IDLE_CURRENT = 0.15  # A
_EMPTY, _FULL = 3.5, 4.18  # V at rest


class Battery:
    """`charge` is the share of the capacity that is left."""

    def __init__(self, charge: float = 1.0):
        self.charge = charge
        self.voltage = self._at_rest

    @property
    def _at_rest(self) -> float:
        return _EMPTY + (_FULL - _EMPTY) * self.charge

    def drain(self, thrust: float, seconds: float) -> None:
        """Give `thrust` N, of all motors together, for a while."""
        current = _IDLE_CURRENT + _CURRENT * (max(thrust, 0.0) / _AT_THRUST) ** 1.5
        self.charge = max(0.0, self.charge - current * seconds / _CAPACITY)
        self.voltage = self._at_rest - _RESISTANCE * current
