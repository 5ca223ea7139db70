"""What can go wrong with a vehicle in the air, each for a time and by a size."""

import math
from dataclasses import dataclass
from enum import StrEnum

from cfplan.errors import InputError


class VehicleFaultKind(StrEnum):
    """What goes wrong."""

    MOTOR = "motor"  # the first motor gives `size` of its thrust
    MASS = "mass"  # the vehicle weighs `size` times what it did
    GUST = "gust"  # air moves with `size` m/s along y
    BATTERY = "battery"  # the voltage falls to `size` V as it is loaded now, and by as much afterwards
    TUMBLE = "tumble"  # both left motors stop
    LOCK = "lock"  # the supervisor locks, for good


_SIZES = {
    VehicleFaultKind.MOTOR: 0.7,
    VehicleFaultKind.MASS: 1.2,
    VehicleFaultKind.GUST: 1.0,
    VehicleFaultKind.BATTERY: 3.1,
}


@dataclass(frozen=True, slots=True)
class VehicleFault:
    """One fault."""

    kind: VehicleFaultKind
    start: float = 0.0
    # s since it was injected
    duration: float = math.inf
    # s
    size: float | None = None
    # in the unit of its kind; None for the usual one

    def __post_init__(self) -> None:
        if math.isnan(self.start) or not self.duration > 0 or (self.size is not None and not math.isfinite(self.size)):
            raise InputError(f"{self} makes no sense", hint="a fault has a start, a positive duration and a size")

    @property
    def strength(self) -> float:
        """The size, or the usual one."""
        return _SIZES.get(self.kind, 0.0) if self.size is None else self.size
