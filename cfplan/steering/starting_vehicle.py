"""The vehicle to fly and the source of its poses, checked first, and started while the flight is prepared."""

import math
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING

from cfplan.errors import InputError
from cfplan.numbers import coordinates, shown

if TYPE_CHECKING:
    from cfplan.flight.mocap.poses import PoseSource
    from cfplan.flight.pilot.process import PilotProcess
    from cfplan.preparation.steps import OnStep
    from cfplan.safety.limits import Limits, PoseLimits
    from cfplan.simulation.lab.lab import StartingLab

SIMULATED = "sim://"
VIRTUAL_SUBJECT = "cf1"  # the only body of the virtual Vicon
VIRTUAL_VICON = "lab"  # host in its motion capture URI
_OPEN_TIMEOUT = 10.0  # s for its first poses, as this computer may be busy


def check_uris(uri: str, mocap_uri: str | None) -> None:
    """Raise InputError if a URI is wrong, or a vehicle has no source of poses. Nothing is connected yet."""
    from cfplan.flight.mocap.uri import EXAMPLE, parse_uri
    from cfplan.flight.radio.uri import check_vehicle_uri

    check_vehicle_uri(uri)
    if mocap_uri is not None:
        mocap = parse_uri(mocap_uri, subject_needed=True)
        if mocap.host == VIRTUAL_VICON and not mocap.system.startswith("vicon") and uri.startswith(SIMULATED):
            raise InputError("the lab has a virtual Vicon only", where=mocap_uri, hint="use vicon:// or vicon-sdk://")
        if mocap.host == VIRTUAL_VICON and uri.startswith(SIMULATED) and mocap.subject != VIRTUAL_SUBJECT:
            raise InputError(
                f"the virtual Vicon sees only {VIRTUAL_SUBJECT!r}, not {mocap.subject!r}",
                where=mocap_uri,
                hint=f"use {mocap.system}://{VIRTUAL_VICON}/{VIRTUAL_SUBJECT}",
            )
    elif not uri.startswith(SIMULATED):
        raise InputError("this vehicle needs a source of poses", where=uri, hint=f"name it with --mocap, as {EXAMPLE}")


def look_at_hardware(uri: str, mocap_uri: str | None, limits: "PoseLimits", on_step: "OnStep") -> None:
    """Check, before anything is planned, that the radio is available, and the body seen, upright and in metres.

    Reports the body's position, for a person to check. Raises a CfplanError, within 5 s.
    """
    from cfplan.flight.mocap.source import pose_source
    from cfplan.flight.radio.crazyradio import check_radio
    from cfplan.preparation.steps import step
    from cfplan.vehicle.rotations import yaw_of

    if uri.startswith("radio://"):
        with step(on_step, "radio") as said:
            check_radio(uri)
            said.append("found, and free")
    if mocap_uri is None or _is_virtual(uri, mocap_uri):
        return
    with step(on_step, "body") as said:
        source = pose_source(mocap_uri, limits)
        try:
            source.open()
            pose = source.poses()[-1]
        finally:
            source.close()
        yaw = math.degrees(yaw_of(pose.quaternion))
        said.append(f"seen at {coordinates(pose.position, '.2f')} m, yaw {shown(yaw, '.0f')}°")


def _is_virtual(uri: str, mocap_uri: str) -> bool:
    """Return whether motion capture is the lab's own, which starts with the lab."""
    from cfplan.flight.mocap.uri import parse_uri

    return uri.startswith(SIMULATED) and parse_uri(mocap_uri, subject_needed=True).host == VIRTUAL_VICON


class StartingVehicle:
    """The pilot's process and, for a virtual vehicle, its lab: both start while the flight is being prepared."""

    def __init__(self, uri: str, mocap_uri: str | None, limits: "Limits"):
        self.uri, self._mocap_uri, self._limits = uri, mocap_uri, limits
        self._open = ExitStack()
        self._lab: StartingLab | None = None
        self.drivers: list[type] = []  # cflib link drivers tried before cflib's own
        if uri.startswith(SIMULATED):
            self._lab = self._open.enter_context(self._launch_lab())
            from cfplan.simulation.lab.sim_driver import SimDriver

            self.drivers = [SimDriver]
        from cfplan.flight.pilot.process import start_pilot

        self.pilot: PilotProcess = self._open.enter_context(start_pilot(self.drivers))

    def _launch_lab(self) -> "StartingLab":
        from cfplan.simulation.lab.lab import launch_lab

        return launch_lab(self._limits.airframe, number=int(self.uri.removeprefix(SIMULATED)))

    def poses(self, on_step: "OnStep") -> "PoseSource":
        """Wait for the lab if there is one; return the source of the vehicle's poses."""
        from cfplan.flight.mocap.source import pose_source
        from cfplan.flight.mocap.uri import parse_uri

        mocap = parse_uri(self._mocap_uri or f"vicon://{VIRTUAL_VICON}/{VIRTUAL_SUBJECT}", subject_needed=True)
        if self._lab is not None:
            from cfplan.preparation.steps import step

            with step(on_step, "lab") as results:
                lab = self._lab.wait()
                results.append(f"the virtual Crazyflie is at {lab.uri}")
            if mocap.host == VIRTUAL_VICON:
                uri = lab.mocap_uri.replace("vicon:", f"{mocap.system}:", 1)
                return pose_source(uri, self._limits.pose, open_within=_OPEN_TIMEOUT)
        return pose_source(str(mocap), self._limits.pose)

    def __enter__(self) -> "StartingVehicle":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
