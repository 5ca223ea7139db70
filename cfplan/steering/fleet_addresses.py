"""The address of each vehicle of a fleet and its body in motion capture, checked before anything is planned."""

from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import quote

from cfplan.errors import InputError
from cfplan.flight.fleet.dongle_process import shared_uri
from cfplan.flight.fleet.inline_radio import (
    INLINE,
    PACKETS_ON_BOARD,
    PACKETS_PER_VEHICLE,
    dongle_mode,
    require_capacity,
    require_inline_settings,
)
from cfplan.flight.mocap.uri import EXAMPLE, parse_uri
from cfplan.flight.radio.crazyradio import find_radios
from cfplan.flight.radio.uri import check_vehicle_uri
from cfplan.planning.fleet.fleet_file import FleetFile
from cfplan.preparation.plan_fleet import steps_of
from cfplan.preparation.steps import OnStep, step
from cfplan.safety.limits import PoseLimits
from cfplan.steering.starting_vehicle import SIMULATED, look_at_hardware

_NOT_IN_BODIES = "/?#%"  # separate or encode the parts of a motion capture system's URI


@dataclass(frozen=True, slots=True)
class VehicleAddress:
    """The two names of a vehicle: by radio, and in motion capture."""

    uri: str
    body: str
    mocap: str = ""  # URI of the body; empty in a virtual room, which has a virtual Vicon
    dongle: str = ""  # number of the dongle, if other vehicles share it; else empty

    @property
    def pilot_uri(self) -> str:
        """Return the URI that its pilot connects to."""
        return shared_uri(self.uri) if self.dongle else self.uri

    @property
    def virtual(self) -> bool:
        return self.uri.startswith(SIMULATED)


def fleet_addresses(fleet: FleetFile, mocap: str | None, *, on_board: bool = False) -> dict[str, VehicleAddress]:
    """Return the addresses of all vehicles by their names; a vehicle without `uri` is sim://0, sim://1, ….

    Args:
        fleet: the vehicles. One without `body` has its name as its body.
        mocap: the motion capture system that sees all of them, as vicon://192.168.1.2; None for virtual vehicles.
        on_board: whether the vehicles fly on board, and need fewer packets.

    Raises InputError if a URI is wrong, two vehicles have one address or one body, too many share a dongle, some are
    virtual and some are not, or they have no motion capture. Nothing is connected yet.
    """
    uris = {vehicle.name: vehicle.uri or f"{SIMULATED}{number}" for number, vehicle in enumerate(fleet.vehicles)}
    bodies = {vehicle.name: vehicle.body or vehicle.name for vehicle in fleet.vehicles}
    for uri in uris.values():
        check_vehicle_uri(uri)
    for name, body in bodies.items():
        if found := sorted(set(body) & set(_NOT_IN_BODIES)):
            raise InputError(
                f"the body of {name}, {body!r}, has {' and '.join(found)} in its name",
                where=fleet.name,
                hint="rename it in motion capture, and write its name as `body`",
            )
    _require_all_virtual_or_none(fleet, mocap)
    _require_different("address", uris, fleet)
    _require_different("body", bodies, fleet)
    dongles: dict[str, str] = {}
    for dongle, numbers in fleet.dongles.items():
        sharing = [fleet.vehicles[number].name for number in numbers]
        for name in sharing:
            require_inline_settings(uris[name])
        require_capacity(dongle, sharing, INLINE, _packets(on_board))
        dongles |= dict.fromkeys(sharing, dongle)
    return {
        name: VehicleAddress(uri, bodies[name], _body_uri(mocap, bodies[name]), dongles.get(name, ""))
        for name, uri in uris.items()
    }


def _packets(on_board: bool) -> float:
    """Return the packets a second that a vehicle needs."""
    return PACKETS_ON_BOARD if on_board else PACKETS_PER_VEHICLE


def look_at_fleet(
    addresses: Mapping[str, VehicleAddress], limits: PoseLimits, on_step: OnStep, *, on_board: bool = False
) -> None:
    """Check, before planning, that each dongle is free and has the capacity for its vehicles, and each body is seen.

    Raises a CfplanError.
    """
    for name, address in addresses.items():
        if not address.virtual:
            look_at_hardware(address.uri, address.mocap, limits, steps_of(name, on_step))
    for dongle in dict.fromkeys(address.dongle for address in addresses.values() if address.dongle):
        with step(on_step, f"dongle {dongle}") as results:
            sharing = [name for name, address in addresses.items() if address.dongle == dongle]
            mode = dongle_mode(find_radios()[int(dongle)].bcdDevice)
            results.append(require_capacity(dongle, sharing, mode, _packets(on_board)))


def _require_all_virtual_or_none(fleet: FleetFile, mocap: str | None) -> None:
    hardware = [each for each in fleet.vehicles if each.uri and not each.uri.startswith(SIMULATED)]
    virtual = [each for each in fleet.vehicles if each not in hardware]
    if hardware and virtual:
        raise InputError(
            f"{virtual[0].name} is a virtual vehicle, and {hardware[0].name} is not",
            where=fleet.name,
            hint="give every vehicle its `uri`, or leave `uri` out for all to fly the fleet virtually",
        )
    if hardware and mocap is None:
        raise InputError(
            "these vehicles need a source of poses",
            where=hardware[0].uri,
            hint="name their motion capture, as --mocap vicon://192.168.1.2; leave out every `uri` to fly virtually",
        )
    if mocap is None:
        return
    if virtual:
        raise InputError(
            "virtual vehicles of a fleet have a virtual Vicon",
            where=mocap,
            hint="leave motion capture out, or give each vehicle its `uri` in the fleet file",
        )
    if body := parse_uri(mocap, subject_needed=False).subject:
        raise InputError(
            f"the body {body!r} cannot be that of every vehicle",
            where=mocap,
            hint=f"leave it out, as in {EXAMPLE.rpartition('/')[0]}; bodies stand in the fleet file",
        )


def _require_different(what: str, names: Mapping[str, str], fleet: FleetFile) -> None:
    """Raise InputError if two vehicles have the same address or body."""
    found: list[tuple[str, str]] = []
    for name, value in names.items():
        for other, before in found:
            if value == before or (what == "address" and _same_vehicle(value, before)):
                raise InputError(
                    f"{other} and {name} have the same {what}, {value!r}", where=fleet.name, hint="give each its own"
                )
        found.append((name, value))


def _body_uri(mocap: str | None, body: str) -> str:
    if mocap is None:
        return ""
    uri = f"{str(parse_uri(mocap, subject_needed=False)).rstrip('/')}/{quote(body, safe='')}"
    parse_uri(uri, subject_needed=True)
    return uri


def _same_vehicle(a: str, b: str) -> bool:
    """Return whether two valid URIs lead to one vehicle: by radio the dongle does not matter, but the rest does."""
    return _vehicle(a) == _vehicle(b)


def _vehicle(uri: str) -> tuple[str, ...]:
    """Return what identifies a vehicle, with cflib's defaults for what a URI leaves out."""
    kind, _, rest = uri.partition("://")
    if kind == "sim":
        return kind, str(int(rest))
    if kind != "radio":
        return kind, rest
    of_vehicle = rest.partition("/")[2].partition("?")[0]  # as check_vehicle_uri() reads it
    channel, rate, address, *_ = [*of_vehicle.split("/"), "", ""]
    return kind, str(int(channel)), rate or "2M", address.upper() or "E7E7E7E7E7"
