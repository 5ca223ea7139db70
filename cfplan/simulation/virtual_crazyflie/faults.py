"""What can go wrong with a vehicle in the air, each for a time and by a size."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from cfplan.simulation.timed_fault import TimedFault


class VehicleFaultKind(StrEnum):
    """What goes wrong."""

    MOTOR = "motor"  # the first motor gives `size` of its thrust
    MASS = "mass"  # the vehicle weighs `size` times what it did
    GUST = "gust"  # air moves with `size` m/s along y
    BATTERY = "battery"  # the voltage falls to `size` V as it is loaded now, and by as much afterwards
    TUMBLE = "tumble"  # both left motors stop
    LOCK = "lock"  # the supervisor locks, for good


@dataclass(frozen=True, slots=True)
class VehicleFault(TimedFault):
    """One fault of the vehicle."""

    kind: VehicleFaultKind
    usual: ClassVar[Mapping[StrEnum, float]] = {
        VehicleFaultKind.MOTOR: 0.7,
        VehicleFaultKind.MASS: 1.2,
        VehicleFaultKind.GUST: 1.0,
        VehicleFaultKind.BATTERY: 3.1,
    }
