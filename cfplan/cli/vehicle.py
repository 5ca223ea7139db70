"""Which vehicle to fly, and where its poses come from."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.cli.output import Steps
    from cfplan.flight.mocap.poses import PoseSource
    from cfplan.safety.limits import Limits, PoseLimits

SIMULATED = "sim://"
VIRTUAL_VICON = "lab"  # as the computer in a URI of motion capture


def check_uris(uri: str, mocap_uri: str | None) -> None:
    """Raises InputError where one is wrong, or a vehicle has no source of poses; looks for nothing yet."""
    from cfplan.flight.mocap.uri import EXAMPLE, parse_uri
    from cfplan.flight.radio.uri import check_vehicle_uri

    check_vehicle_uri(uri)
    if mocap_uri is not None:
        mocap = parse_uri(mocap_uri, subject_needed=True)
        if mocap.host == VIRTUAL_VICON and not mocap.system.startswith("vicon") and uri.startswith(SIMULATED):
            raise InputError("the lab has a virtual Vicon only", where=mocap_uri, hint="use vicon:// or vicon-sdk://")
    elif not uri.startswith(SIMULATED):
        raise InputError("where do its poses come from?", where=uri, hint=f"name it with --mocap, as {EXAMPLE}")


def look_at_hardware(uri: str, mocap_uri: str | None, limits: "PoseLimits", steps: "Steps") -> None:
    """Before anything is planned: is the radio to be had, and is the body seen, upright and in metres?

    Raises a CfplanError, within 5 s. Says where the body is, which a person can check with a glance.
    """
    from cfplan.flight.mocap.source import pose_source
    from cfplan.flight.radio.crazyradio import check_radio
    from cfplan.vehicle.rotations import yaw_of

    if uri.startswith("radio://"):
        with steps.step("radio") as said:
            check_radio(uri)
            said.append("there, and free")
    if mocap_uri is None or _is_virtual(uri, mocap_uri):
        return
    with steps.step("body") as said:
        source = pose_source(mocap_uri, limits)
        try:
            source.open()
            pose = source.poses()[-1]
        finally:
            source.close()
        x, y, z = pose.position
        said.append(f"seen at {x:.2f} {y:.2f} {z:.2f} m, yaw {math.degrees(yaw_of(pose.quaternion)):.0f}°")


def _is_virtual(uri: str, mocap_uri: str) -> bool:
    """Whether it is the lab's own, which is not there before the lab is."""
    from cfplan.flight.mocap.uri import parse_uri

    return uri.startswith(SIMULATED) and parse_uri(mocap_uri, subject_needed=True).host == VIRTUAL_VICON


@contextmanager
def vehicle(uri: str, mocap_uri: str | None, limits: "Limits") -> "Iterator[tuple[list[type], PoseSource]]":
    """The link drivers and the poses for a URI; for the virtual Crazyflie, its lab too."""
    from cfplan.flight.mocap.source import pose_source
    from cfplan.flight.mocap.uri import parse_uri

    mocap = parse_uri(mocap_uri, subject_needed=True) if mocap_uri is not None else None
    if not uri.startswith(SIMULATED):
        yield [], pose_source(str(mocap), limits.pose)
        return
    from cfplan.simulation.lab.lab import start_lab
    from cfplan.simulation.lab.room import RoomPoseSource, RoomSettings
    from cfplan.simulation.lab.sim_driver import SimDriver, lab_number
    from cfplan.simulation.virtual_vicon.cameras import ViconSettings

    number = lab_number(uri)
    if mocap is None:
        with start_lab(limits.airframe, number=number) as lab:
            yield [SimDriver], RoomPoseSource(lab.number)
    elif mocap.host == VIRTUAL_VICON:
        room = RoomSettings(vicon=ViconSettings(subject=mocap.subject))
        with start_lab(limits.airframe, room=room, number=number) as lab:
            there = lab.mocap_uri.replace("vicon:", f"{mocap.system}:", 1)
            yield [SimDriver], pose_source(there, limits.pose)
    else:
        with start_lab(limits.airframe, number=number):
            yield [SimDriver], pose_source(str(mocap), limits.pose)
