"""A room with several virtual vehicles: one lab, one virtual Vicon, and an address for each vehicle."""

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType

from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.mocap.source import pose_source
from cfplan.safety.limits import Limits
from cfplan.simulation.lab.lab import Lab, launch_lab
from cfplan.simulation.lab.room import RoomSettings, lab_variable
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.steering.starting_vehicle import SIMULATED

_OPENS_WITHIN = 10.0  # s for first poses: the cameras see them, but this computer may be busy


@dataclass(frozen=True, slots=True)
class VehiclePlace:
    """A vehicle of a room: its address, its body, and where it stands."""

    uri: str
    body: str
    position: tuple[float, float]  # m, on the floor
    yaw: float = 0.0  # rad


class FleetRoom:
    """A running lab with a vehicle at each place; a context manager. Raises what starting a lab raises."""

    def __init__(self, places: Sequence[VehiclePlace], limits: Limits):
        self._limits, self._open = limits, ExitStack()
        self._variables: dict[str, str | None] = {}  # of the environment, as they were before
        (first, *others) = places
        lab = self._open.enter_context(
            launch_lab(
                limits.airframe,
                vehicle=_settings(first, 0),
                companions={place.body: _settings(place, number) for number, place in enumerate(others, start=1)},
                room=RoomSettings(ViconSettings(subject=first.body)),
                number=_number(first.uri),
            )
        )
        try:
            self.lab: Lab = lab.wait()
        except BaseException:
            self._open.close()
            raise
        for place, port in zip(others, self.lab.ports[1:], strict=True):
            self._announce(_number(place.uri), port)

    def poses(self, body: str) -> PoseSource:
        """Return the source of the poses of a body."""
        uri = f"{self.lab.mocap_uri.rpartition('/')[0]}/{body}"
        return pose_source(uri, self._limits.pose, open_within=_OPENS_WITHIN)

    def _announce(self, number: int, port: int) -> None:
        """Let `sim://number` find a vehicle of this room."""
        name = lab_variable(number)
        self._variables[name] = os.environ.get(name)
        os.environ[name] = f"127.0.0.1:{port}"

    def __enter__(self) -> "FleetRoom":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _restore(self._variables)
        self._open.close()


def _restore(variables: Mapping[str, str | None]) -> None:
    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def _settings(place: VehiclePlace, number: int) -> VehicleSettings:
    return VehicleSettings(position=(*place.position, 0.0), yaw=place.yaw, seed=VehicleSettings().seed + number)


def _number(uri: str) -> int:
    return int(uri.removeprefix(SIMULATED))
