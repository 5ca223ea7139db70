"""Addresses of vehicles in the files of other tools: crazyflies.yaml of crazyswarm2, and swarm files of cfcli.

robots:                     # crazyswarm2: vehicles by name
  cf1: {enabled: true, uri: radio://0/80/2M/E7E7E7E701, initial_position: [0, 0, 0], type: cf21}

units:                      # cfcli: a list of vehicles
  - {uri: radio://0/80/2M/E7E7E7E701, name: cf1}

Only names, addresses and `enabled` are read; all other keys are ignored.
"""

import difflib
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cfplan.errors import InputError
from cfplan.files.yaml_with_places import read_plain, read_yaml_with_places

_LISTED = 12  # most names in an error message


@dataclass(frozen=True, slots=True)
class AddressFile:
    """The addresses of vehicles by their names."""

    file: str
    uris: dict[str, str]
    disabled: frozenset[str]  # names of vehicles that are switched off in the file
    places: dict[str, str]  # `file:line:column` of each vehicle

    def uri(self, name: str, where: str) -> str:
        """Return the address of a vehicle. Raises InputError, at `where`, if it is not listed, or is disabled."""
        if name in self.disabled:
            raise InputError(
                f"{name} is disabled",
                where=self.places[name],
                hint="write `enabled: true`, or leave it out of the fleet",
            )
        if name not in self.uris:
            close = difflib.get_close_matches(name, self.uris, 1)
            meant = f"did you mean {close[0]!r}? " if close else ""
            names = ", ".join(sorted(self.uris)[:_LISTED]) or "no vehicle"
            raise InputError(f"{name} is not in {self.file}", where=where, hint=f"{meant}it lists {names}")
        return self.uris[name]


class _Model(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _Robot(_Model):
    uri: str
    enabled: bool = True


class _Robots(_Model):
    robots: dict[str, _Robot]


class _Unit(_Model):
    uri: str
    name: str


class _Units(_Model):
    units: list[_Unit]


def read_address_file(file: Path) -> AddressFile:
    """Read the addresses in a crazyflies.yaml or a swarm file. Raises InputError with the place of a mistake."""
    content = read_plain(file)
    if "robots" in content:
        return _read_robots(file)
    if "units" in content:
        return _read_units(file)
    raise InputError(
        "neither a crazyflies.yaml nor a swarm file: it has neither `robots` nor `units`",
        where=str(file),
        hint="name the crazyflies.yaml of crazyswarm2, or a swarm file of cfcli",
    )


def _read_robots(file: Path) -> AddressFile:
    robots, places = read_yaml_with_places(file, _Robots)
    return AddressFile(
        str(file),
        {name: robot.uri for name, robot in robots.robots.items()},
        frozenset(name for name, robot in robots.robots.items() if not robot.enabled),
        {name: places.where_key("robots", name) for name in robots.robots},
    )


def _read_units(file: Path) -> AddressFile:
    units, places = read_yaml_with_places(file, _Units)
    uris: dict[str, str] = {}
    found: dict[str, str] = {}
    for number, unit in enumerate(units.units):
        where = places.where("units", number)
        if unit.name in uris:
            raise InputError(f"two units have the name {unit.name!r}", where=where, hint="give each its own")
        uris[unit.name], found[unit.name] = unit.uri, where
    return AddressFile(str(file), uris, frozenset(), found)
