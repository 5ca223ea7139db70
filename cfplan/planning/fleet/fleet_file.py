"""Fleet files: vehicles by name with their paths, and the distance to keep between them.

apart: 0.30          # m between the vertical columns of any two vehicles
skew: 0.03           # s by which their clocks may differ
addresses: crazyflies.yaml   # of vehicles without `uri`; also a swarm file of cfcli
lost: refuse         # a fleet in which a lost vehicle may come too near to another; warn: plan it all the same
vehicles:
  left: {path: ../circle.yaml, place: {x: -1.0}}
  right: {path: ../line.yaml, place: {x: 1.0, yaw_deg: 90}, uri: radio://0/80/2M/E7E7E7E702, body: cf2}
"""

import itertools
import pathlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from cfplan.errors import InputError
from cfplan.files.yaml_with_places import HINT, Places, read_plain, read_yaml_with_places
from cfplan.geometry.path_file import PathFile, PathPlace, load_path_file
from cfplan.planning.fleet.address_file import read_address_file
from cfplan.planning.fleet.separation import CLEAR, allowed_deviation

FEWEST, MOST = 2, 6  # vehicles
APART = 0.35  # m, which allows each vehicle 0.075 m off its path, see separation.py; dry runs need some 0.065 m
LEAST_APART = 0.30  # m
SKEW = 0.03  # s: three ticks of the clock of a pilot
_LEAST = {  # least value, unit and hint
    "apart": (
        LEAST_APART,
        "m",
        f"{CLEAR:g} m between vehicles, and {allowed_deviation(LEAST_APART):g} m for each off its path; leave it out "
        "for the default",
    ),
    "skew": (SKEW, "s", "pilots begin and obey within some ticks of 0.01 s; leave it out for the default"),
}
_KEY = "vehicles"


@dataclass(frozen=True, slots=True)
class FleetVehicle:
    """A vehicle of a fleet file, and the path that it flies."""

    name: str
    path_file: PathFile  # in its place in the room
    uri: str = ""  # its address, as radio://0/80/2M/E7E7E7E701
    body: str = ""  # its name in motion capture


@dataclass(frozen=True, slots=True)
class FleetFile:
    """The content of a fleet file."""

    name: str
    vehicles: tuple[FleetVehicle, ...]
    apart: float  # m, at least, between the vertical columns of any two vehicles
    skew: float  # s, largest difference between clocks, and between the arrivals of an order to stop
    lost_only_warns: bool = False  # of a lost vehicle that may come too near to another; else the fleet is refused

    @property
    def dongles(self) -> dict[str, tuple[int, ...]]:
        """Return the numbers of the vehicles of each dongle that two or more share, by the dongle's name."""
        names = [_dongle(vehicle.uri) for vehicle in self.vehicles]
        shared = {name: tuple(n for n, each in enumerate(names) if each == name) for name in names if name}
        return {name: numbers for name, numbers in shared.items() if len(numbers) > 1}


class _Vehicle(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str
    uri: str = ""
    body: str = ""
    place: PathPlace = PathPlace()


class _Content(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(default="", max_length=100, pattern=r"^[^\n\r]*$")
    apart: float = Field(default=APART, le=5.0)
    skew: float = Field(default=SKEW, le=0.2)
    lost: Literal["refuse", "warn"] = "refuse"
    addresses: str = ""  # name of a file with the addresses of vehicles without `uri`
    vehicles: dict[str, _Vehicle]

    @field_validator("apart", "skew")
    @classmethod
    def _wide_enough(cls, value: float, info: ValidationInfo) -> float:
        least, unit, why = _LEAST[info.field_name or ""]
        if not value >= least:
            raise ValueError(f"must be at least {least:g} {unit}, not {value:g}{HINT}{why}")
        return value


def is_fleet_file(file: pathlib.Path) -> bool:
    """Return whether a file lists vehicles; a file that cannot be read does not."""
    if file.suffix.lower() not in (".yaml", ".yml") or not file.is_file():
        return False
    try:
        return _KEY in read_plain(file)
    except InputError:
        return False


def load_fleet_file(file: pathlib.Path) -> FleetFile:
    """Read a fleet file and the path file of each vehicle.

    Raises:
        InputError: a mistake in it, in a path file or in the file of addresses; too few or too many vehicles; two with
            one address or one body; two whose starts or whose ends are closer than they must keep apart.
    """
    content, places = read_yaml_with_places(file, _Content)
    if not FEWEST <= len(content.vehicles) <= MOST:
        raise InputError(
            f"a fleet has {FEWEST} to {MOST} vehicles, not {len(content.vehicles)}",
            where=places.where_key(_KEY),
            hint="a single vehicle flies a path file" if len(content.vehicles) < FEWEST else "leave some out",
        )
    vehicles = tuple(_vehicles(content, file.parent, places))
    fleet = FleetFile(content.name or file.stem, vehicles, content.apart, content.skew, content.lost == "warn")
    for a, b in itertools.combinations(vehicles, 2):
        _check_pair(a, b, fleet, places)
    return fleet


def _dongle(uri: str) -> str:
    """Return the name of the dongle in an address, as 0 in radio://0/80/2M; empty where there is none."""
    found = re.match(r"radio://([^/?]+)", uri)
    return found[1].upper() if found else ""  # a serial number in either case


def _vehicles(content: _Content, folder: pathlib.Path, places: Places) -> Iterator[FleetVehicle]:
    listed = read_address_file(folder / content.addresses) if content.addresses else None
    for name, each in content.vehicles.items():
        if not name.isprintable() or not 0 < len(name) <= 40:
            raise InputError(
                "a vehicle's name has 1 to 40 printable characters",
                where=places.where_key(_KEY, name),
                hint="use the name on its label, such as cf1",
            )
        source = folder / each.path
        if not source.is_file():
            raise InputError(
                f"no such path file: {each.path!r}",
                where=places.where(_KEY, name, "path"),
                hint="the name is relative to the fleet file",
            )
        uri = each.uri or (listed.uri(name, places.where_key(_KEY, name)) if listed is not None else "")
        uri = re.sub(r"^radio://0+(?=\d)", "radio://", uri)  # radio://00 is the dongle of radio://0
        yield FleetVehicle(name, load_path_file(source).placed(*each.place.motion), uri, each.body)


def _check_pair(a: FleetVehicle, b: FleetVehicle, fleet: FleetFile, places: Places) -> None:
    """Raise InputError if two vehicles cannot be distinguished, or stand too close to each other."""
    for key in ("uri", "body"):
        if getattr(a, key) and getattr(a, key) == getattr(b, key):
            raise InputError(
                f"{a.name} and {b.name} have the same {key}",
                where=places.where(_KEY, b.name, key),
                hint="give each vehicle its own",
            )
    for row, what in ((0, "start"), (-1, "end")):
        (xa, ya, _), (xb, yb, _) = a.path_file.waypoints[row], b.path_file.waypoints[row]
        distance = float(np.hypot(xa - xb, ya - yb))
        if not distance >= fleet.apart:
            raise InputError(
                f"{a.name} and {b.name} {what} {distance:.2f} m from each other; they must keep {fleet.apart:g} m",
                where=places.where(_KEY, b.name),
                hint=f"move one of them with `place`, so that each {what}s under a free column of air",
            )
