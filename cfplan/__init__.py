"""cfplan: plan, certify, rehearse, fly and replay time-optimal Crazyflie flights."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cfplan.errors import (
    CfplanError,
    FlightEndedError,
    InfeasibleError,
    InputError,
    LinkError,
    NotCertifiedError,
    PreflightError,
    RequestRefusedError,
)
from cfplan.version import __version__

if TYPE_CHECKING:
    from cfplan.air.requests import PathAnswer, PathVerdict, Wish
    from cfplan.preparation.from_programs import load_path, plan, rehearse
    from cfplan.preparation.plan_flight import PlannedFlight as Plan
    from cfplan.safety.limits_file import load_limits
    from cfplan.steering.connect import connect
    from cfplan.steering.connected_fleet import ConnectedFleet, connect_fleet
    from cfplan.steering.steered_vehicle import SteeredVehicle

__all__ = [
    "CfplanError",
    "ConnectedFleet",
    "FlightEndedError",
    "InfeasibleError",
    "InputError",
    "LinkError",
    "NotCertifiedError",
    "PathAnswer",
    "PathVerdict",
    "Plan",
    "PreflightError",
    "RequestRefusedError",
    "SteeredVehicle",
    "Wish",
    "__version__",
    "connect",
    "connect_fleet",
    "load_limits",
    "load_path",
    "plan",
    "rehearse",
]

_PLACES = {
    "ConnectedFleet": ("cfplan.steering.connected_fleet", "ConnectedFleet"),
    "PathAnswer": ("cfplan.air.requests", "PathAnswer"),
    "PathVerdict": ("cfplan.air.requests", "PathVerdict"),
    "Plan": ("cfplan.preparation.plan_flight", "PlannedFlight"),
    "SteeredVehicle": ("cfplan.steering.steered_vehicle", "SteeredVehicle"),
    "Wish": ("cfplan.air.requests", "Wish"),
    "connect": ("cfplan.steering.connect", "connect"),
    "connect_fleet": ("cfplan.steering.connected_fleet", "connect_fleet"),
    "load_limits": ("cfplan.safety.limits_file", "load_limits"),
    "load_path": ("cfplan.preparation.from_programs", "load_path"),
    "plan": ("cfplan.preparation.from_programs", "plan"),
    "rehearse": ("cfplan.preparation.from_programs", "rehearse"),
}


def __getattr__(name: str) -> Any:
    """Import what programs use when they ask for it: commands must begin at once."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, inside = _PLACES[name]
    return getattr(import_module(module), inside)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
