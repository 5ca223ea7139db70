"""Faults of a vehicle in the air, each for a time and by a size."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from cfplan.simulation.timed_fault import TimedFault


class VehicleFaultKind(StrEnum):
    """Kinds of faults."""

    MOTOR = "motor"  # the first motor gives `size` of its thrust
    MASS = "mass"  # the vehicle's mass is `size` times its own
    GUST = "gust"  # air moves with `size` m/s along y
    BATTERY = "battery"  # the voltage under the present load falls to `size` V, and stays that much lower
    TUMBLE = "tumble"  # both left motors stop
    LOCK = "lock"  # the supervisor locks, for good
    DECK = "deck"  # a deck reports a fault, which firmware from 2026.08 on obeys
    SILENT_ESTIMATE = "estimate log silent"  # blocks with the estimated position are not sent
    SILENT_STATUS = "status log silent"  # blocks with the supervisor's state are not sent


# A variable of the log block that each fault silences.
SILENCED: Mapping[StrEnum, str] = {
    VehicleFaultKind.SILENT_ESTIMATE: "stateEstimateZ.x",
    VehicleFaultKind.SILENT_STATUS: "supervisor.info",
}
FIRMWARE_FAULTS = frozenset((VehicleFaultKind.LOCK, VehicleFaultKind.DECK, *SILENCED))  # others are of body or battery


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
